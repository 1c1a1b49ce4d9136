"""Progress bars, on a terminal and in notebooks."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from ..notebook import in_notebook
from .sample import Sample, Sink, TakeRows

if TYPE_CHECKING:
    from tqdm import tqdm

    from .experiments import Experiment

SILENCE = 1.0  # s until a notebook shows a bar
BAR = "{desc} {percentage:3.0f}% |{bar}| {n:.1f}/{total:.1f} s, {remaining} left"


def _bar(what: str, unit: str, **options: object) -> tqdm:
    """Return a bar of tqdm that disappears at its end: a widget if the notebook has widgets, else text."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ipywidgets may be missing
        from tqdm.auto import tqdm
    return tqdm(desc=what, unit=unit, leave=False, delay=SILENCE * in_notebook(), **options)


@contextmanager
def counting(what: str, unit: str, *, shown: bool) -> Iterator[Callable[[int, int], None]]:
    """Return a callback that shows the numbers of finished and of all runs in a bar, or does nothing."""
    with ExitStack() as stack:
        bar: tqdm | None = None

        def show(done: int, total: int) -> None:
            nonlocal bar
            if bar is None:  # runs of an earlier sweep must not count for the rate
                options = {"total": total, "initial": done, "smoothing": 0.05, "disable": not shown}
                bar = stack.enter_context(_bar(what, unit, **options))
            bar.update(done - bar.n)

        yield show


class Progress(Sink):
    """Progress bar over the simulated time."""

    @property
    def takes_rows(self) -> bool:
        """True: the time alone is shown."""
        return True

    def begin(self, run: Experiment) -> Progress:
        """Receive the experiment; return self."""
        self._step = run.step
        self._bar = _bar("simulating", "s", total=run.steps * run.step, bar_format=BAR)
        return self

    def write(self, sample: Sample) -> None:
        """Show the time of a sample."""
        self._bar.update(self._step if sample.k else 0.0)

    def take_rows(self, first: Sample) -> TakeRows:
        """Show the time of the first sample; return a function that shows that of further ones."""
        self.write(first)
        return lambda rows: self._bar.update(self._step * len(rows))

    def __exit__(self, *exception: object) -> None:
        self._bar.close()
