"""Drive an FMU in real time from a page in the browser."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from functools import partial
from math import inf
from pathlib import Path

from ..errors import InputError
from ..fmu import Fmu
from ..signatures import ignore, never
from ..simulation.experiments import experiment
from ..simulation.input_values import Setting
from .arm import arm_of, arm_page
from .loop import Loop
from .serving import HOST, PORT, Connection, Server, user_token

RATE = 30.0  # Hz, updates to pages


def live(
    fmu: Fmu | str | Path,
    stop: Callable[[], bool] = never,
    opened: Callable[[str], None] = ignore,
    *,
    host: str = HOST,
    port: int = PORT,
    step: float | None = None,
    settings: Mapping[str, Setting] | None = None,
    bag: str | None = None,
    command_line: str = "",
) -> list[Path]:
    """Step an FMU in real time behind a page until ``stop`` returns true; return the recorded bags.

    Args:
        fmu: the FMU or its path.
        stop: called between two steps.
        opened: called with the URL when the page can be opened.
        host, port: address to listen on.
        step: communication step, s; None: the FMU's default.
        settings: start values, as in ``experiment``.
        bag: name of the first recording; None: rosbag2_<date and time>.
        command_line: command line for the provenance of recordings.

    Raises:
        FmuError, InputError, PageError, SimulationError: before the page is served.
    """
    run = experiment(fmu, step=step, stop_time=inf, settings=settings)
    loop, arm = Loop(run, bag=bag, command_line=command_line), arm_of(run)
    page = arm_page(arm.title, arm, {}, "; connect-src 'self'")
    with Server(page, host, port, partial(_talk, loop), token=user_token()) as server:
        opened(server.url)
        loop.play(stop)
    return loop.recorded


async def _talk(loop: Loop, connection: Connection) -> None:
    """Send updates to one page at its own pace, and pass its requests to the loop."""
    received, seen, before = 0, {"run": 0, "seen": 0}, None

    async def listen() -> None:
        nonlocal received
        async for text in connection:
            try:
                order, value = json.loads(text)
                loop.tell(order, value)
            except InputError as error:
                loop.note(str(error))
            except (ValueError, TypeError, AttributeError):
                return  # not one of our pages
            received += 1
            await asyncio.sleep(1 / RATE if loop.behind else 0.0)  # so that updates are sent too

    loop.viewers += 1
    listening = asyncio.ensure_future(listen())
    try:
        while not listening.done():
            news = loop.news(**seen)
            seen = {name: news[name] for name in seen}
            rest = {**news, "rows": [], "seen": 0, "received": received}
            if news["rows"] or rest != before:
                await connection.send(json.dumps({**news, "received": received}))
                before = rest
            await asyncio.sleep(1 / RATE)
    finally:
        loop.viewers -= 1
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)
