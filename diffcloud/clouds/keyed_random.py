"""Random numbers as a function of a key and a position: a batch of independent streams without a generator for each.

SplitMix64 (Steele, Lea & Flood 2014) over key + n · golden ratio, in 64-bit integers, so that a stream is the same whatever
the batch it is drawn in, the process, and the device.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_GOLDEN = 0x9E3779B97F4A7C15 - 2**64
_FIRST, _SECOND = 0xBF58476D1CE4E5B9 - 2**64, 0x94D049BB133111EB - 2**64
_BITS = 21
"""Of each number: a word of 64 bits gives three, finer than a float32 resolves a place on a face."""


def stream_keys(*parts: Tensor | int) -> Tensor:
    """[B] int64 keys, one for each combination of `parts` (whole numbers, or tensors [B] of them); their order counts."""
    key = torch.zeros((), dtype=torch.int64)
    for part in parts:
        key = _mix((torch.as_tensor(part, dtype=torch.int64) ^ key) + _GOLDEN)
    return key


def uniform(keys: Tensor, count: int) -> Tensor:
    """[B] keys -> float32 [B, count, 3] in [0, 1)."""
    position = torch.arange(1, count + 1, device=keys.device) * _GOLDEN
    words = _mix(keys[:, None] + position)
    numbers = torch.stack([words >> 1, words >> 1 + _BITS, words >> 1 + 2 * _BITS], dim=-1)
    return numbers.bitwise_and_(2**_BITS - 1).to(torch.float32).mul_(2.0**-_BITS)


def normal(keys: Tensor, count: int) -> Tensor:
    """[B] keys -> float32 [B, count, 3], standard normal (Box & Muller)."""
    first, second = uniform(keys, 2 * count).split(count, dim=1)
    radius = torch.log1p(-first).mul_(-2).sqrt_()  # finite: 1 - u is never zero
    return radius * second.mul_(2 * math.pi).cos_()


def _mix(words: Tensor) -> Tensor:
    """The finaliser, in place."""
    words ^= _shifted(words, 30)
    words *= _FIRST
    words ^= _shifted(words, 27)
    words *= _SECOND
    words ^= _shifted(words, 31)
    return words


def _shifted(words: Tensor, places: int) -> Tensor:
    """Logical shift to the right; torch's own keeps the sign."""
    return (words >> places).bitwise_and_(2 ** (64 - places) - 1)
