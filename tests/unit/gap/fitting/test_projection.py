"""What a projection makes of columns a few clusters at a time, against all of them projected at once."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from dtprob.gap.fitting.projection import Known, Projection


def _projection(n_global, n_local, *, clusters=70, rows=5):
    """A projection with random tangents and unit priors, so that it is no orthogonal one."""
    rng = np.random.default_rng(n_global + 10 * n_local)
    shared, own = rng.normal(size=(clusters, rows, n_global)), rng.normal(size=(clusters, rows, n_local))
    inverse = np.linalg.inv(np.swapaxes(own, 1, 2) @ own + np.eye(n_local))
    reduced = shared - own @ (inverse @ (np.swapaxes(own, 1, 2) @ shared))
    curvature = np.einsum("cmi,cmj->ij", shared, reduced) + np.eye(n_global)
    nothing = Known(np.zeros(n_global), np.zeros(n_global)), Known(*np.zeros((2, clusters, n_local)))
    arrays = (shared, own, inverse, np.linalg.inv(curvature), reduced)
    return Projection(*arrays, *nothing, np.zeros(n_global), None)


@pytest.mark.parametrize(("n_global", "n_local"), [(3, 2), (3, 0), (0, 2), (0, 0)])
def test_information_and_scores_are_those_of_projected_columns(n_global, n_local):
    projection, rng = _projection(n_global, n_local), np.random.default_rng(1)
    columns, rows = rng.normal(size=(70, 5, 4)), rng.normal(size=(6, 70, 5))
    adjusted, coefficients = projection.adjust(columns)
    information, found = projection.information(columns)
    np.testing.assert_allclose(information, np.einsum("cmi,cmj->ij", columns, adjusted), atol=1e-10)
    np.testing.assert_allclose(found, coefficients, atol=1e-12)
    score = np.einsum("cmk,rcm->rk", columns, projection.adjoint(rows))
    np.testing.assert_allclose(score, np.einsum("cmk,rcm->rk", adjusted, rows), atol=1e-10)


def test_a_prior_adds_the_same_numbers_whatever_they_are_drawn_with():
    projection = replace(_projection(3, 2), shared=Known(np.zeros(3), np.full(3, 2.0)))
    keys = jax.random.split(jax.random.key(0), 6)
    drawn = jax.vmap(lambda key: jax.random.normal(jax.random.fold_in(key, 0), (3,)))(keys)
    rows = projection.with_prior(np.zeros((6, 70, 5)), keys)
    np.testing.assert_allclose(rows, np.einsum("cmg,rg->rcm", projection.columns, 2 * drawn), atol=1e-12)
