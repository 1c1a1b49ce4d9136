"""Film of a run, drawn without a display: the arm in its workspace, in the views of the run's figure."""

import io
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen

import numpy as np

from ..bag.recording import Recording
from ..bounds import MAX_FRAMES
from ..errors import PlotError
from ..export.closed_form import Array
from ..files import refusing, temporary_folder, write_file
from ..version import needing
from .figure import Drawing, draw_head, drawn, plain_style
from .panels import title
from .runs import draw_view
from .settings import number
from .strokes import GREY, line_styles
from .track import Track, read_tracks
from .words import common_settings, outcome
from .workspace import views

# isort: split
from matplotlib.backends.backend_agg import FigureCanvasAgg  # figure raises if matplotlib is missing
from matplotlib.figure import Figure
from matplotlib.image import imsave

SIZE, DOTS = (8.0, 4.5), 160  # inches, and pixels per inch: 1280 × 720
PALETTE = "split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=none"
FILMS = {
    ".mp4": (30, "libx264 -pix_fmt yuv420p -crf 23 -preset veryfast -movflags +faststart"),
    ".webp": (30, "libwebp_anim -pix_fmt yuv420p -loop 0 -quality 75"),
    ".gif": (25, f"gif -pix_fmt pal8 -filter_complex {PALETTE}"),
}
"""Frames per second, and codec with options of FFmpeg, by suffix; a frame of a GIF lasts whole hundredths of a second.
"""


def film(
    bag: Recording | str | Path, output: str | Path, *, urdf: str | Path | None = None, frame: str | None = None
) -> None:
    """Write a bag as a film of 1280 × 720 pixels in real time, or the picture at its end.

    Args:
        output: the file, written completely or not at all; its suffix, of ``FILMS`` or .png, selects the format.
        urdf, frame: the robot and its end effector, as in ``track.read_tracks``.

    Raises:
        BagError: the bag cannot be read.
        PlotError: there is no robot, the extra "video" is missing, or the file cannot be written.
    """
    path, track = Path(output), read_tracks([bag], urdf=urdf, frame=frame)[0]
    if track.motion is None:
        raise PlotError(f"'{track.recording.path}' contains no robot; give one with `urdf`")
    kind, end, content = path.suffix.lower(), float(track.t[-1]), io.BytesIO()
    with plain_style():
        if kind == ".png":
            shape = (round(SIZE[1] * DOTS), round(SIZE[0] * DOTS), 4)
            for picture in _frames(track, np.array([end])):
                imsave(content, np.frombuffer(picture, np.uint8).reshape(shape), format="png")
        else:
            fps, codec = FILMS[kind]
            if end * fps > MAX_FRAMES:
                raise PlotError(f"'{track.recording.path}' has {end:g} s; a film has at most {MAX_FRAMES / fps:g} s")
            times, options = np.arange(round(end * fps) + 1) / fps, ["-r", str(fps), "-i", "-", "-vcodec"]
            content.write(_encoded(_frames(track, times), path, [*options, *codec.split()]))
    with refusing(PlotError, f"write '{path}'"):
        write_file(path, content.getvalue())


def _encoded(frames: Iterator[bytes], path: Path, options: Sequence[str]) -> bytes:
    """Return frames as a file's content, by FFmpeg; imageio's own writer hides that it failed."""
    with needing(PlotError, f"write '{path}'", "video"):
        from imageio_ffmpeg import get_ffmpeg_exe
    size = "x".join(str(round(side * DOTS)) for side in SIZE)
    with temporary_folder() as folder:
        file = folder / f"film{path.suffix.lower()}"
        command = [get_ffmpeg_exe(), "-f", "rawvideo", "-s", size, "-pix_fmt", "rgba", *options, str(file)]
        with suppress(BrokenPipeError), Popen(command, stdin=PIPE, stdout=DEVNULL, stderr=DEVNULL) as encoder:
            assert encoder.stdin is not None
            for frame in frames:
                encoder.stdin.write(frame)
        if encoder.returncode:
            where = f"exit status {encoder.returncode}; is there room in '{folder.parent}'?"
            raise PlotError(f"cannot write '{path}': FFmpeg failed, {where}")
        return file.read_bytes()


def _frames(track: Track, times: Array) -> Iterator[bytes]:
    """Yield pictures of the run at times since its first sample, s: red, green, blue and alpha of each pixel.

    Static parts are drawn once; the arm's points are computed from interpolated joint positions.
    """
    figure = drawn(Drawing(title([track]), track.name, partial(_draw, track), ()))
    figure.set_dpi(DOTS)
    canvas = FigureCanvasAgg(figure)
    arms = [axes.lines[-1] for axes in figure.axes]
    clock = figure.text(0.99, 0.02, "", ha="right", color=GREY, animated=True)
    canvas.draw()
    still, points = canvas.copy_from_bbox(figure.bbox), track.skeletons(times)
    planes = [["xyz".index(letter) for letter in str(axes.get_label())] for axes in figure.axes]
    for t, arm in zip(times, points):
        canvas.restore_region(still)
        clock.set_text(f"{t:.2f} s of {number(float(track.t[-1]))} s")
        for line, plane in zip(arms, planes):
            line.set_data(*arm[:, plane].T)
            figure.draw_artist(line)
        figure.draw_artist(clock)
        yield bytes(canvas.buffer_rgba())


def _draw(track: Track, figure: Figure) -> None:
    """Draw the static parts, and the arm of each view as its last line, which is moved later."""
    room = draw_head(figure, title([track]), [common_settings([track]), *outcome(track)[:1]], SIZE)
    figure.set_size_inches(SIZE)
    every = views([track], {(0, ""): line_styles([track.name])[0]})
    for axes, view in zip(room.subplots(1, len(every), squeeze=False)[0], every):
        arms = [stroke for stroke in view.strokes if stroke.label == "arm at the end"]
        others = [stroke for stroke in view.strokes if stroke.label != "arm at the end"]
        draw_view(axes, view._replace(strokes=(*others, *arms)))
        seen = track.skeletons(track.t)[:, :, ["xyz".index(letter) for letter in view.axes]].reshape(-1, 2)
        (left, low), (right, high) = seen.min(axis=0), seen.max(axis=0)
        axes.set_xlim(min(view.across[0], left), max(view.across[1], right), auto=True)
        axes.set_ylim(min(view.up[0], low), max(view.up[1], high), auto=True)
        axes.set_label(view.axes)
        axes.lines[-1].set_animated(True)
