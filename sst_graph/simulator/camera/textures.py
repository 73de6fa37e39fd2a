"""Periodic textures of all materials in one atlas with all its halvings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sst_graph.simulator.surfaces import FACADES, MATERIALS, Material
from sst_graph.types import FloatArray

TILE = 512
"""Side of a tile [px]."""
LEVELS = 8
"""Halvings kept of each tile, the full size included."""

Image = NDArray[Any]


@dataclass(frozen=True)
class Atlas:
    """Tiles side by side, one band per halving, each tile framed by one wrapped pixel.

    Attributes:
        pixels: (h, w) or (h, w, 3) uint8.
        bands: (LEVELS,) first row of each band.
    """

    pixels: Image
    bands: FloatArray

    def sample(self, tile: Image, u: Image, v: Image, level: Image) -> Image:
        """Texture at coordinates u, v (h, w) in tiles, of tiles numbered ``tile`` at halvings ``level``."""
        size = np.float32(TILE) * np.exp2(-level).astype(np.float32)
        x = (u - np.floor(u)) * size + np.float32(0.5) + tile * (size + np.float32(2.0))
        y = (v - np.floor(v)) * size + np.float32(0.5) + self.bands.astype(np.float32)[level.astype(np.intp)]
        sampled: Image = cv2.remap(self.pixels, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        return sampled


def make_atlas(tiles: list[Image]) -> Atlas:
    """The atlas of equal square uint8 tiles."""
    bands, first, row = [], [], 0
    for level in range(LEVELS):
        size = TILE >> level
        scaled = [
            tile if level == 0 else cv2.resize(tile, (size, size), interpolation=cv2.INTER_AREA)
            for tile in tiles
        ]
        band = np.concatenate([cv2.copyMakeBorder(t, 1, 1, 1, 1, cv2.BORDER_WRAP) for t in scaled], axis=1)
        width = len(tiles) * (TILE + 2)
        padding = [(0, 0), (0, width - band.shape[1])] + [(0, 0)] * (band.ndim - 2)
        bands.append(np.pad(band, padding))
        first.append(float(row))
        row += size + 2
    return Atlas(np.concatenate(bands), np.array(first))


def smooth_noise(rng: np.random.Generator, sigma: float, size: int = TILE) -> FloatArray:
    """(size, size) periodic noise of zero mean and unit deviation, correlated over ``sigma`` pixels."""
    coarse = 1
    while sigma / coarse >= 4.0:
        coarse *= 2
    small = size // coarse
    white = rng.standard_normal((small, small), dtype=np.float32)
    if sigma <= 0.3:
        return white.astype(np.float64)
    pad = min(small, int(4 * sigma / coarse) + 2)
    padded = cv2.copyMakeBorder(white, pad, pad, pad, pad, cv2.BORDER_WRAP)
    blurred = cv2.GaussianBlur(padded, (0, 0), sigma / coarse)
    if coarse > 1:
        blurred = cv2.resize(blurred, (blurred.shape[1] * coarse, blurred.shape[0] * coarse))
    inner = blurred[pad * coarse : pad * coarse + size, pad * coarse : pad * coarse + size].astype(np.float64)
    return np.asarray((inner - inner.mean()) / inner.std())


def _tile(luminance: FloatArray, tint: FloatArray | None = None) -> Image:
    """A BGR tile from luminance (s, s), 1 is full, and an optional tint (s, s, 3) to multiply with."""
    colour = np.repeat(luminance[:, :, None], 3, axis=2)
    if tint is not None:
        colour = colour * tint
    return np.clip(colour * 200.0, 0, 255).astype(np.uint8)


def material_atlas(rng: np.random.Generator) -> Atlas:
    """The tiles of all materials, drawn afresh for each street."""
    plain = 0.95 + 0.03 * smooth_noise(rng, 20.0)
    tiles: dict[int, Image] = {material: _tile(plain) for material in range(MATERIALS)}
    stains = smooth_noise(rng, 25.0) + 0.7 * smooth_noise(rng, 8.0)
    asphalt = 0.9 + 0.035 * stains + 0.05 * smooth_noise(rng, 0.7)
    asphalt[np.abs(smooth_noise(rng, 14.0)) < 0.02] *= 0.6
    tiles[Material.ASPHALT] = _tile(asphalt)
    tiles[Material.PAVING] = _tile(_slabs(rng, 8, 16) * (1.0 + 0.05 * smooth_noise(rng, 12.0)))
    grass = (
        0.8 + 0.16 * smooth_noise(rng, 3.0) + 0.14 * smooth_noise(rng, 0.8) + 0.1 * smooth_noise(rng, 30.0)
    )
    tiles[Material.GRASS] = _tile(
        grass, 1.0 + 0.1 * smooth_noise(rng, 20.0)[:, :, None] * np.array([0.3, 0.2, 1.0])
    )
    leaves = (
        0.75 + 0.3 * smooth_noise(rng, 4.0) + 0.3 * smooth_noise(rng, 1.2) + 0.15 * smooth_noise(rng, 16.0)
    )
    tiles[Material.LEAVES] = _tile(
        np.clip(leaves, 0.12, None),
        1.0 + 0.12 * smooth_noise(rng, 8.0)[:, :, None] * np.array([0.2, 0.3, 1.0]),
    )
    bark = 0.75 + 0.25 * cv2.resize(smooth_noise(rng, 1.5, 128), (TILE, TILE)).astype(np.float64)
    tiles[Material.BARK] = _tile(np.clip(bark, 0.15, None))
    rows = 0.75 + 0.25 * np.sin(2 * np.pi * 16 * np.arange(TILE) / TILE)[:, None]
    tiles[Material.ROOF] = _tile(
        rows * (0.9 + 0.08 * smooth_noise(rng, 3.0) + 0.06 * smooth_noise(rng, 25.0))
    )
    sky_line = np.linspace(1.3, 0.5, TILE)[:, None] * np.ones(TILE)
    tiles[Material.GLASS] = _tile(sky_line + 0.25 * smooth_noise(rng, 40.0))
    tiles[Material.PANEL] = _lettered(rng)
    for k in range(FACADES):
        tiles[Material.FACADE + k] = _facade(rng)
    return make_atlas([tiles[material] for material in range(MATERIALS)])


def detail_atlas(rng: np.random.Generator) -> Atlas:
    """One grey tile of fine grain, 128 in the mean."""
    grain = (
        0.5 * smooth_noise(rng, 0.8)
        + 0.6 * smooth_noise(rng, 2.0)
        + 0.5 * smooth_noise(rng, 6.0)
        + 0.4 * smooth_noise(rng, 18.0)
    )
    return make_atlas([np.clip(128 + 26 * grain, 0, 255).astype(np.uint8)])


def _slabs(rng: np.random.Generator, columns: int, rows: int) -> FloatArray:
    """(TILE, TILE) slabs of slightly different brightness between dark joints."""
    wide, high = TILE // columns, TILE // rows
    slabs = np.kron(0.9 + 0.07 * rng.standard_normal((rows, columns)), np.ones((high, wide)))
    for row in range(rows):
        slabs[row * high : (row + 1) * high] = np.roll(
            slabs[row * high : (row + 1) * high], (row % 2) * wide // 2, axis=1
        )
        joints = (np.arange(0, TILE, wide) + (row % 2) * wide // 2) % TILE
        slabs[row * high : (row + 1) * high, joints] *= 0.65
        slabs[row * high] *= 0.65
    return np.asarray(slabs, np.float64)


def _facade(rng: np.random.Generator) -> Image:
    """A BGR facade of 12 m x 12 m: four floors of windows, each a little different, on a structured wall."""
    brick = rng.uniform() < 0.3
    wall = (_slabs(rng, 32, 64) if brick else np.ones((TILE, TILE))) * (0.92 + 0.05 * smooth_noise(rng, 20.0))
    wall += 0.03 * smooth_noise(rng, 2.0)
    image = _tile(wall)
    bays, floor = int(rng.integers(3, 6)), TILE // 4
    bay = TILE / bays
    width, height = bay * rng.uniform(0.35, 0.6), floor * rng.uniform(0.42, 0.6)
    frame = float(rng.uniform(90, 230))
    for row in range(4):
        for column in range(bays):
            x = int((column + 0.5) * bay - width / 2 + rng.normal(0, 1.0))
            # Texture rows run upwards from the ground.
            y = int(row * floor + floor * 0.3)
            if rng.uniform() < 0.08:
                continue
            _window(image, rng, (x, y, int(width), int(height)), frame)
        if rng.uniform() < 0.5:
            cv2.rectangle(image, (0, row * floor), (TILE - 1, row * floor + 4), (150, 150, 150), -1)
    return image


def _window(image: Image, rng: np.random.Generator, box: tuple[int, int, int, int], frame: float) -> None:
    """Draws one window: sill, frame, panes, now and then a blind or a curtain."""
    x, y, w, h = box
    cv2.rectangle(image, (x - 3, y - 5), (x + w + 3, y - 1), (170, 170, 170), -1)
    cv2.rectangle(image, (x, y), (x + w, y + h), (frame, frame, frame), -1)
    dark = rng.uniform(20, 70)
    pane = (dark * rng.uniform(1.0, 1.6), dark * 1.1, dark)
    cv2.rectangle(image, (x + 3, y + 3), (x + w - 3, y + h - 3), pane, -1)
    if rng.uniform() < 0.4:
        drop = int(h * rng.uniform(0.2, 0.8))
        grey = rng.uniform(100, 210)
        cv2.rectangle(image, (x + 3, y + h - drop), (x + w - 3, y + h - 3), (grey, grey, grey * 0.95), -1)
    middle = x + w // 2
    cv2.line(image, (middle, y), (middle, y + h), (frame, frame, frame), 3)
    if rng.uniform() < 0.5:
        cv2.line(image, (x, y + int(h * 0.7)), (x + w, y + int(h * 0.7)), (frame, frame, frame), 2)


def _lettered(rng: np.random.Generator) -> Image:
    """A truck's side: ribs, a stripe and some lettering."""
    image = _tile(0.95 + 0.02 * smooth_noise(rng, 10.0))
    image[:, ::43] = (image[:, ::43] * 0.85).astype(np.uint8)
    word = "".join(rng.choice(list("AEIKLMNORSTUVX"), 6))
    panel = np.full((TILE // 4, TILE, 3), 255, np.uint8)
    cv2.putText(panel, word, (20, 90), cv2.FONT_HERSHEY_SIMPLEX, 3.2, rng.uniform(0, 200, 3).tolist(), 16)
    # Texture rows run upwards.
    band = image[100 : 100 + TILE // 4]
    np.multiply(band, panel[::-1] / 255.0, out=band, casting="unsafe")
    colour = rng.uniform(40, 220, 3)
    image[60:84] = colour.astype(np.uint8)
    return image


def sky_panorama(rng: np.random.Generator) -> Image:
    """(256, 1024, 3) uint8 sky: azimuth across (periodic), 60 deg above the horizon (top) to 10 below."""
    up = np.linspace(60.0, -10.0, 256)[:, None]
    fade = np.clip(up / 45.0, 0.0, 1.0)[:, :, None]
    blue = (1 - fade) * np.array([235.0, 225.0, 215.0]) + fade * np.array([225.0, 160.0, 105.0])
    noise = (
        cv2.resize(smooth_noise(rng, 12.0, 256), (1024, 512))[:256]
        + 0.5 * cv2.resize(smooth_noise(rng, 5.0, 512), (1024, 512))[:256]
    )
    cover = np.clip((noise + rng.uniform(-0.8, 0.8)) * 0.7, 0.0, 1.0)[:, :, None]
    image: Image = np.clip(blue * (1 - cover) + 242.0 * cover, 0, 255).astype(np.uint8)
    return image
