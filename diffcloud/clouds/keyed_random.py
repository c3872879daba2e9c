"""Random numbers as functions of a key and a position: independent streams without generator objects.

Uses SplitMix64 (Steele, Lea & Flood 2014) on key + n · golden ratio, in 64-bit integers. So a stream does not depend on the
batch, the process or the device.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_GOLDEN = 0x9E3779B97F4A7C15 - 2**64
_FIRST, _SECOND = 0xBF58476D1CE4E5B9 - 2**64, 0x94D049BB133111EB - 2**64
_BITS = 21
"""Bits per number. A 64-bit word gives three numbers, which is more precise than a float32 position on a face."""


def stream_keys(*parts: Tensor | int) -> Tensor:
    """Keys [B] (int64), one for each combination of `parts` (integers, or tensors [B] of them). The order of the parts
    matters."""
    key = torch.zeros((), dtype=torch.int64)
    for part in parts:
        key = _mix((torch.as_tensor(part, dtype=torch.int64) ^ key) + _GOLDEN)
    return key


def uniform(keys: Tensor, count: int) -> Tensor:
    """Uniform numbers in [0, 1), float32 [B, count, 3], for keys [B]."""
    position = torch.arange(1, count + 1, device=keys.device) * _GOLDEN
    words = _mix(keys[:, None] + position)
    numbers = torch.stack([words >> 1, words >> 1 + _BITS, words >> 1 + 2 * _BITS], dim=-1)
    return numbers.bitwise_and_(2**_BITS - 1).to(torch.float32).mul_(2.0**-_BITS)


def normal(keys: Tensor, count: int) -> Tensor:
    """Standard normal numbers, float32 [B, count, 3], for keys [B] (Box & Muller)."""
    first, second = uniform(keys, 2 * count).split(count, dim=1)
    radius = torch.log1p(-first).mul_(-2).sqrt_()  # finite: 1 - u is never zero
    return radius * second.mul_(2 * math.pi).cos_()


def _mix(words: Tensor) -> Tensor:
    """Output function of SplitMix64, in place."""
    words ^= _shifted(words, 30)
    words *= _FIRST
    words ^= _shifted(words, 27)
    words *= _SECOND
    words ^= _shifted(words, 31)
    return words


def _shifted(words: Tensor, places: int) -> Tensor:
    """Logical right shift. (torch's operator keeps the sign.)"""
    return (words >> places).bitwise_and_(2 ** (64 - places) - 1)
