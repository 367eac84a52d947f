"""Kernels that are written from their source: what is compiled does what Python does, and what cannot be is refused."""

import numpy as np
import pytest
from numba import njit
from numba.core.errors import NumbaError

from tca_envs.mechanics.traced import choose, spread, traced, where
from tca_envs.mechanics.written import written


@traced
def straight(x, y):
    return x * y - 2.0 * x / y + 0.5, -x


@written
def branching(x, n):
    total, sign = 0.0, 1.0
    for k in range(1, n + 1):
        if k % 3 == 0:
            total -= x * k
        elif total > 4.0:
            total *= 0.5
        else:
            first, second = straight(total + x, x + k)
            total += sign * first + second
        sign = -sign
    return total


@written
def halved(x):
    steps = 0.0
    while True:
        if not x > 1.0:
            break
        x *= 0.5
        steps += 1.0
    return where(steps > 2.0, steps, -steps)


@pytest.mark.parametrize("x", [0.3, 1.7, -2.2])
@pytest.mark.parametrize("n", [0, 1, 2, 7, 30])
def test_loops_and_branches_are_those_of_python(x, n):
    compiled = njit(lambda a, b: branching(a, b))
    assert compiled(x, n) == pytest.approx(branching(x, n), rel=1e-13, abs=1e-13)


@pytest.mark.parametrize("x", [0.5, 3.0, 1000.0])
def test_a_loop_ends_where_pythons_does(x):
    compiled = njit(lambda a: halved(a))
    assert compiled(x) == halved(x)


def test_packs_choose_number_by_number():
    @njit
    def chosen(a, b):
        return chosen_part(a, b)

    @traced
    def chosen_part(a, b):
        from tca_envs.mechanics.traced import part

        return part(choose(spread(a), spread(b), spread(1.0), spread(2.0)), 3)

    assert (chosen(0.0, 1.0), chosen(1.0, 0.0), chosen(np.nan, 1.0)) == (1.0, 2.0, 2.0)


@written
def returns_in_the_middle(x):
    if x > 0.0:
        return x
    return -x


@written
def uses_and(x):
    total = 0.0
    if x > 0.0 and x < 1.0:
        total += x
    return total


@pytest.mark.parametrize("function", [returns_in_the_middle, uses_and])
def test_what_cannot_be_written_is_refused_when_it_is_compiled(function):
    assert function(0.5) == 0.5
    with pytest.raises((NumbaError, SyntaxError, TypeError)):
        njit(lambda x: function(x))(0.5)
