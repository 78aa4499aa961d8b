# SPDX-License-Identifier: LGPL-3.0-or-later
"""Frames into a film: mp4 by ffmpeg, gif by Pillow; for one process.

A film is written under another name and renamed when it is complete. Knows images alone.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from complexbody.errors import MissingPackage, OutputError

KINDS = ("mp4", "gif")


def ffmpeg() -> str | None:
    """Where ffmpeg is: the system's, else that of imageio-ffmpeg; None without both."""
    found = shutil.which("ffmpeg")
    if found is None and find_spec("imageio_ffmpeg") is not None:
        import imageio_ffmpeg

        try:
            found = imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError:  # it comes without a program for this machine
            found = None
    return found


def kind_of(wanted: str) -> str:
    """The kind of film: "auto" is mp4 where there is ffmpeg, else gif."""
    return ("mp4" if ffmpeg() else "gif") if wanted == "auto" else wanted


def require_movie(kind: str) -> None:
    """See that a film of this kind can be made.

    Raises:
        MissingPackage: if what makes it is missing.
    """
    if kind == "mp4" and ffmpeg() is None:
        raise MissingPackage(
            "Show: there is no ffmpeg for mp4. Run: pip install imageio-ffmpeg (or apt-get install "
            "ffmpeg), or ask for a gif"
        )
    if kind == "gif" and find_spec("PIL") is None:
        raise MissingPackage("Show: there is no Pillow for gif. Run: pip install pillow")


def write_movie(path: Path, frames: Iterable[Any], fps: float) -> int:
    """Write frames, all of one size (height, width, 3), uint8, to a .mp4 or .gif file.

    Returns:
        How many there were.

    Raises:
        MissingPackage: if ffmpeg or Pillow is missing.
        OutputError: if ffmpeg fails.
        OSError: if the file cannot be written.
    """
    require_movie(path.suffix[1:])
    draft = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        count = (_mp4 if path.suffix == ".mp4" else _gif)(draft, iter(frames), fps)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return count


def _mp4(path: Path, frames: Iterator[Any], fps: float) -> int:
    first = next(frames)
    height, width = (size - size % 2 for size in first.shape[:2])  # as the format wants them
    command = [
        str(ffmpeg()), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
        "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-", "-an", "-c:v", "libx264",
        "-crf", "18", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path),
    ]  # fmt: skip
    count = 0
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=said)
        assert process.stdin is not None
        try:
            frame = first
            while frame is not None:
                process.stdin.write(np.ascontiguousarray(frame[:height, :width]).tobytes())
                count, frame = count + 1, next(frames, None)
            process.stdin.close()
        except BrokenPipeError:
            pass  # ffmpeg says why
        except BaseException:
            process.kill()
            raise
        finally:
            code = process.wait()
        if code != 0:
            said.seek(0)
            why = said.read().decode(errors="replace").strip().splitlines()[-1:]
            raise OutputError(
                f"Show: ffmpeg could not write {path} ({''.join(why)}). Make room, give another "
                "folder, or ask for a gif."
            )
    return count


def _gif(path: Path, frames: Iterator[Any], fps: float) -> int:
    from PIL import Image

    count = 0

    def reduced() -> Iterator[Any]:
        nonlocal count
        for frame in frames:
            count += 1
            # Dots of other colours, to make up for those that are missing, would flicker.
            yield Image.fromarray(frame).quantize(256, dither=Image.Dither.NONE)

    images = reduced()
    first = next(images)
    # The format counts in hundredths of a second.
    lasts = max(20, 10 * round(100 / fps))
    first.save(path, "GIF", save_all=True, append_images=images, duration=lasts, loop=0)
    return count
