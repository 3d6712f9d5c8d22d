"""Codebooks and palettes: exact where values are few, near the plain k-means otherwise, the same twice."""

import numpy as np
import torch

from scene_experts.files.formats.clusters import LEVELS, codebook, nearest_levels, palette


def test_few_values_come_back_exactly():
    values = np.array([[3.0, -1.0], [2.5, 3.0]])
    book = codebook(values)
    assert len(book) == LEVELS and np.array_equal(book[nearest_levels(values, book)], values)
    assert np.array_equal(codebook(np.zeros(0)), np.zeros(LEVELS)) and (codebook(np.full(1000, 7.0)) == 7).all()


def test_a_codebook_beats_even_steps_and_indices_are_the_nearest():
    values = np.random.default_rng(0).standard_t(3, 50_000)
    book = codebook(values)
    assert (np.diff(book) >= 0).all()
    index = nearest_levels(values[:500], book)
    assert np.array_equal(np.abs(values[:500, None] - book).min(1), np.abs(values[:500] - book[index]))
    even = np.linspace(values.min(), values.max(), LEVELS)
    error = lambda b: ((values - b[nearest_levels(values, b)]) ** 2).mean()  # noqa: E731
    assert error(book) < 0.2 * error(even)


def test_a_palette_finds_clusters_and_repeats_itself():
    g = torch.Generator().manual_seed(0)
    kinds = torch.randn(64, 9, generator=g)
    which = torch.randint(64, (6000,), generator=g)
    vectors = kinds[which] + 0.02 * torch.randn(6000, 9, generator=g)
    rows, label = palette(vectors, 512)
    assert len(rows) <= 512 and label.max() < len(rows) and label.min() >= 0
    assert ((vectors - rows[label]) ** 2).mean().sqrt() < 0.025
    again, same = palette(vectors, 512)
    assert torch.equal(rows, again) and torch.equal(label, same)


def test_as_many_rows_as_vectors_is_exact_and_equal_vectors_do_no_harm():
    vectors = torch.randn(20, 3)
    rows, label = palette(vectors, 32)
    assert torch.equal(rows[label], vectors)
    rows, label = palette(torch.ones(3000, 4), 16)
    assert torch.equal(rows[label], torch.ones(3000, 4)) and len(rows) <= 16
