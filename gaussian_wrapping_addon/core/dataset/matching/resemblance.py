# SPDX-License-Identifier: GPL-3.0-or-later
"""How much photos resemble each other, by the features that were found in them (VLAD).

A vocabulary is learnt from the set's own descriptors by k-means; a photo is described by how its
descriptors differ from their words (docs/method.md, section 15.1).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

WORDS = 64
SAMPLED_DESCRIPTORS = 60_000
"""Of all photos together, for the vocabulary."""
DESCRIBING = 2048
"""Most descriptors of a photo that describe it: of the largest features, which come last."""
_ROUNDS = 12

ReadDescriptors = Callable[[int], np.ndarray]
"""Returns the (m, 128) uint8 descriptors of a photo by its number, m may be 0."""


def resemblances(count: int, read: ReadDescriptors, *, seed: int) -> np.ndarray:
    """Return the (count, count) float32 resemblance of photos, 1 for equal ones.

    The same for the same seed. A photo without features resembles none: 0.
    """
    vectors = photo_vectors(count, read, vocabulary(count, read, seed=seed))
    return vectors @ vectors.T


def vocabulary(count: int, read: ReadDescriptors, *, seed: int) -> np.ndarray:
    """Return the (w, 128) float32 words learnt from a sample of all descriptors."""
    chance = np.random.default_rng(seed)
    each = max(SAMPLED_DESCRIPTORS // max(count, 1), 1)
    samples = []
    for number in range(count):
        found = _unit(read(number)[-DESCRIBING:])
        picked = chance.permutation(len(found))[:each]
        samples.append(found[np.sort(picked)])
    sample = np.concatenate(samples) if samples else np.zeros((0, 128), np.float32)
    words = sample[np.sort(chance.permutation(len(sample))[:WORDS])]
    for _ in range(_ROUNDS if len(words) else 0):
        nearest = _nearest_words(sample, words)
        sums = np.zeros(words.shape)
        np.add.at(sums, nearest, sample)
        counts = np.bincount(nearest, minlength=len(words))
        # A word that nothing is near to stays where it is.
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words)
        words = words.astype(np.float32)
    return words


def photo_vectors(count: int, read: ReadDescriptors, words: np.ndarray) -> np.ndarray:
    """Return the (count, w * 128) float32 unit vectors of photos, 0 of photos without features."""
    vectors = np.zeros((count, words.size), np.float32)
    for number in range(count):
        found = _unit(read(number)[-DESCRIBING:])
        if not len(found) or not len(words):
            continue
        nearest = _nearest_words(found, words)
        apart = np.zeros(words.shape, np.float32)
        np.add.at(apart, nearest, found - words[nearest])
        # Words that a photo has very often (grass) must not outweigh the others.
        length = np.linalg.norm(apart, axis=1, keepdims=True)
        apart = apart / np.maximum(length, 1e-12) * np.sqrt(length)
        flat = np.sign(apart) * np.sqrt(np.abs(apart))
        vectors[number] = (flat / max(float(np.linalg.norm(flat)), 1e-12)).ravel()
    # What all photos have in common tells nothing about who resembles whom.
    has_any = np.any(vectors != 0.0, axis=1)
    if has_any.any():
        vectors[has_any] -= vectors[has_any].mean(0)
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        vectors /= np.maximum(lengths, 1e-12)
    return vectors


def _unit(descriptors: np.ndarray) -> np.ndarray:
    found = descriptors.astype(np.float32)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)


def _nearest_words(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return the (n,) numbers of the words nearest to unit descriptors."""
    return np.argmax(descriptors @ words.T - 0.5 * (words**2).sum(1), axis=1)
