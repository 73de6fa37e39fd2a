"""Reading back the videos that tests write."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def read_video(path: Path) -> tuple[list[NDArray[np.uint8]], float]:
    """Pictures of a video, and its rate [Hz]."""
    video = cv2.VideoCapture(str(path))
    pictures = []
    while (read := video.read())[0]:
        pictures.append(np.asarray(read[1], np.uint8))
    return pictures, video.get(cv2.CAP_PROP_FPS)
