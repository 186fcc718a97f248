"""Orbits that are never at rest, found from any state, against a scan made elsewhere, another
integrator and the monodromy in one piece.
"""

import math
from dataclasses import replace

import jax
import numpy as np
import pytest
from elsewhere import PASSAGES, monodromy

import dpend
from dpend import Pendulum, State, Status

CENTRED = (2, 5, 10, 13)
# Near an orbit without symmetry; its period is within 1e-3 of this.
ASYMMETRIC, ITS_PERIOD = State(0.533, 1.206, -1.889, 0.502), 5.8993


def passage(energy, upright, phi):
    """The state with this energy at (0, 0) or (0, pi), m = l = g = 1."""
    c = -1.0 if upright else 1.0
    inertia = np.linalg.cholesky([[2.0, c], [c, 1.0]])
    p = inertia @ [math.cos(phi), math.sin(phi)] * math.sqrt(2 * (energy + 2 + c))
    return State(0.0, upright * math.pi, float(p[0]), float(p[1]))


def columns(state):
    return np.stack([np.asarray(leaf, float) for leaf in jax.tree.leaves(state)])


def motion(orbit):
    """The states at sixtieths of the period, by diffrax, as columns."""
    start = State(*map(float, columns(orbit.state)))
    times = np.arange(1, 61) / 60 * float(orbit.period)
    return columns(dpend.reference(orbit.pendulum, start, times, error=False).state)


def assert_comes_back(orbit, atol=1e-9):
    """By diffrax: after half the period at the dual, after the whole where it began, but for full
    turns; kappa is that of the monodromy in one piece. The states at both times.
    """
    end = motion(orbit)[:, [29, 59]]
    np.testing.assert_allclose(end[:, 0], columns(orbit.dual), atol=atol)
    turned = end[:, 1] - columns(orbit.state)
    turned[:2] -= 2 * math.pi * np.round(turned[:2] / (2 * math.pi))
    np.testing.assert_allclose(turned, 0, atol=atol)
    kappa = (np.trace(monodromy(orbit, 1.0)) - 2) / 2
    np.testing.assert_allclose(orbit.kappa, kappa, rtol=1e-8)
    return end


@pytest.mark.parametrize(
    "i", [0, 2, *(pytest.param(i, marks=pytest.mark.slow) for i in (1, *range(3, 14)))]
)
def test_passages_that_a_scan_found(unit, i):
    """From a direction 1e-4 off, at the same energy, with the symmetry found out: the period, the
    full turns, and half a period later {0, pi}^2 again.
    """
    period, upright, phi, half = PASSAGES[i]
    orbit = dpend.find_orbit(unit, state=passage(0.0, upright, phi + 1e-4), period=period)
    assert orbit.status == Status.CONVERGED
    assert orbit.symmetry == ("centred" if i in CENTRED else "passing")
    np.testing.assert_allclose([orbit.period, orbit.energy], [period, 0], rtol=1.5e-8, atol=1e-12)
    end = assert_comes_back(orbit)
    if orbit.symmetry == "passing":
        assert orbit.turns == half
        whole = end[:2, 1] - columns(orbit.state)[:2]
        np.testing.assert_allclose(whole, 2 * math.pi * np.array(half), atol=1e-9)
        np.testing.assert_allclose(np.sin(end[:2, 0]), 0, atol=1e-9)
        assert max(orbit.error_estimate) < 1e-12


def test_an_orbit_without_symmetry(unit):
    """Found from three digits of a state; neither reversal nor reflection brings it back."""
    orbit = dpend.find_orbit(unit, state=ASYMMETRIC, period=ITS_PERIOD)
    assert (orbit.symmetry, int(orbit.status)) == ("none", Status.CONVERGED)
    energy = dpend.hamiltonian(unit, ASYMMETRIC)
    np.testing.assert_allclose([orbit.period, orbit.energy], [ITS_PERIOD, energy], rtol=1e-3)
    np.testing.assert_allclose(orbit.energy, energy, atol=1e-12)
    assert_comes_back(orbit)
    assert orbit.turns == (0, 0)
    states = motion(orbit)
    scale = np.max(np.abs(states), axis=1)[:, None]
    for image in ([-1, -1, -1, -1], [1, 1, -1, -1], [-1, -1, 1, 1]):
        of_first = np.array(image)[:, None] * states[:, :1]
        assert np.min(np.max(np.abs(states - of_first) / scale, axis=0)) > 0.15


def test_from_anywhere_on_an_orbit_and_twice_around_it(unit):
    """A centred orbit of a normal mode, met 0.3 of its period after the release, is told for what
    it is, also where the period given is that of two; the energy or the period is kept.
    """
    known = dpend.find_orbit(unit, 1.5, branch="in-phase")
    period = float(known.period)
    there = State(*map(float, motion(known)[:, 17]))
    for keep, covers in (("energy", 1), ("period", 2)):
        orbit = dpend.find_orbit(unit, state=there, period=covers * period, keep=keep)
        assert (orbit.symmetry, int(orbit.status)) == ("centred", Status.CONVERGED)
        np.testing.assert_allclose(
            [abs(orbit.theta1), orbit.period, orbit.kappa], [1.5, period, known.kappa], rtol=1e-9
        )


def test_what_comes_to_nothing_says_so(unit):
    """Full turns that no orbit near the motion makes; the pendulum at rest."""
    passing = passage(0.0, 0, 1.716424)
    far = dpend.find_orbit(unit, state=passing, period=2.95, symmetry="passing", turns=(5, -7))
    assert far.status in (Status.MAX_ITERATIONS, Status.NONFINITE)
    still = dpend.find_orbit(unit, state=dpend.released(1e-9, 0.0), period=8.2, symmetry="brake")
    assert still.status == Status.TRIVIAL_ROOT


@pytest.mark.slow
def test_derivatives_at_a_kept_energy_and_a_kept_period(unit):
    """Beside central differences: with respect to a mass, of an orbit with the energy of its state,
    and to the period.
    """
    start = passage(0.0, 0, 1.716424)

    def period(m2):
        return dpend.find_orbit(replace(unit, m2=m2), state=start, period=2.953489).period

    def energy(period):
        return dpend.find_orbit(unit, state=start, period=period, keep="period").energy

    for function, x in ((period, 1.0), (energy, 2.95)):
        h = 1e-4
        numeric = (function(x + h) - function(x - h)) / (2 * h)
        np.testing.assert_allclose(jax.jacfwd(function)(x), numeric, rtol=1e-6)


@pytest.mark.slow
def test_families_of_rotating_orbits(unit):
    """From the upright pendulum to free rotation, where an orbit does not feel gravity: period
    times the square root of the kinetic energy is that of the pendulum without it.
    """
    orbit = dpend.find_orbit(unit, state=passage(0.0, 0, 1.716424), period=2.953489)
    family = dpend.follow_family(unit, orbit)
    assert (family.symmetry, family.ends) == ("passing", ("homoclinic", "fast rotation"))
    assert family.status == Status.CONVERGED
    np.testing.assert_array_equal([np.unique(turns) for turns in family.orbits.turns], [[0], [1]])
    fast = family.orbits.period * np.sqrt(family.orbits.energy - -1.0)
    np.testing.assert_allclose(fast[-1], fast[-2], rtol=1e-4)
    for energy, crossing in ((-0.5, 1), (-0.5, 2), (20.0, 1)):
        found = family.at(energy=energy, crossing=crossing)
        assert found.status == Status.CONVERGED
        assert_comes_back(found)
    with pytest.raises(ValueError, match="theta1 must not be given for passing orbits"):
        family.at(0.5)


@pytest.mark.slow
def test_orbits_of_the_odd_branch_by_their_energy(unit):
    """Of the branch that leaves the anti-phase family where it loses its stability, the orbits of
    five energies: by diffrax x(T/2) = -x(0), at the energies that were asked for.
    """
    family = dpend.follow_family(unit, "anti-phase")
    lost = next(point for point in family.special_points if point.kind == "stability_lost")
    branch = dpend.follow_family(unit, lost)
    energies = np.array([-1.5, -1.0, -0.5, 0.0, 1.0])
    orbits = branch.at(energy=energies)
    np.testing.assert_array_equal(orbits.status, Status.CONVERGED)
    np.testing.assert_allclose(orbits.energy, energies, atol=1e-13)
    for i in range(5):
        orbit = jax.tree.map(lambda leaf, i=i: leaf[i], orbits)
        end = assert_comes_back(orbit)
        np.testing.assert_allclose(end[:, 0], -columns(orbit.state), atol=1e-9)
    # Where x(T/2) = -x(0) itself is lost, orbits without any symmetry branch off.
    broken = next(point for point in branch.special_points if point.kind == "stability_lost")
    other = dpend.find_orbit(unit, state=ASYMMETRIC, period=ITS_PERIOD)
    passed = dpend.follow_family(unit, other, longest_period=6.5)
    gap = np.abs(passed.orbits.energy - broken.orbit.energy) + np.abs(
        passed.orbits.period - broken.orbit.period
    )
    assert passed.symmetry == "none"
    assert np.min(gap) < 1e-3


@pytest.mark.slow
def test_both_sides_of_a_resonance_of_odd_order():
    """At 3:1 one curve of orbits of three periods passes through: energies below on one side and
    above on the other, whether they rest or pass.
    """
    pendulum, seen = Pendulum(1.0, 3.0, 1.0, 0.3, 1.0), set()
    family = dpend.follow_family(pendulum, "in-phase")
    for point in family.special_points:
        if not point.kind.startswith("stability"):
            continue
        branch = dpend.follow_family(pendulum, point, most_points=40)
        third = next((p for p in branch.special_points if p.kind == "resonance_3:1"), None)
        if third is None or branch.symmetry in seen | {"odd"}:
            continue
        seen.add(branch.symmetry)
        tripled = dpend.follow_family(pendulum, third, most_points=5)
        assert tripled.symmetry == branch.symmetry
        np.testing.assert_allclose(tripled.orbits.period, 3 * third.orbit.period, rtol=0.1)
        offsets = tripled.orbits.energy - third.orbit.energy
        assert np.min(offsets) < 0 < np.max(offsets)
        comes = jax.tree.map(lambda leaf: leaf[2], tripled.orbits)
        assert_comes_back(comes, atol=1e-8)
    assert seen == {"brake", "passing"}
