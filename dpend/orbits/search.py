"""The walk along a branch to the release that is wanted, and Newton's method for that release."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from dpend.checks import Scalar
from dpend.mechanics.pendulum import Pendulum
from dpend.orbits.arc import MOST_SEGMENT_STEPS, TURN, UNKNOWNS, arc_of
from dpend.orbits.newton import METRIC, THETA1, THETA2, TOLERANCE, Aim, Solved, no_point
from dpend.orbits.walk import LONGEST_STEP, STRAYED, Walk, hermite, start_at_mode, take_step
from dpend.status import Status

# Each step is looked at in this many pieces for crossings: no step turns enough to cross twice
# within one of them.
_PIECES = 16
# Halvings of a piece, down to the last place of a share.
_HALVINGS = 50
# A search gives up after so many points or attempts.
_MOST_POINTS, _MOST_ATTEMPTS = 5000, 15_000
# It gives up after so many steps of a segment, summed over Newton's iterations: about half a minute
# on one core (13 microseconds each at m2/m1 = 1e7). At m2/m1 = 1 a search needs 100 to 1000 of
# them, at 1e3 some 20 000.
_MOST_WORK = 2_000_000
# The square of an update is the next one, to this factor squared: with a tolerance of 1e-13
# Newton's method ends where it does on the walk.
_LAST_UPDATE = TOLERANCE / 1e-13**0.5
# Where a search stands, as a status that is none yet: on its way, or at the wanted release.
_WALKING, _LOCATED = -1, -2


class Wish(NamedTuple):
    """The release that is sought.

    Attributes:
        target: |theta1|.
        crossing: which passage through it.
        ratio: zero, or the release with theta2 = ratio theta1 nearest to `target` is sought.
    """

    target: Scalar
    crossing: Scalar
    ratio: Scalar

    def miss(self, angles: Array) -> Scalar:
        """Zero at the wanted release, or its mirror image."""
        at_angle = jnp.abs(angles[0]) - self.target
        return jnp.where(self.ratio == 0, at_angle, angles[1] - self.ratio * angles[0])


class Search(NamedTuple):
    """A walk along a branch to where it meets the wanted release.

    Attributes:
        root: the wanted orbit when it is solved; until then, and where the branch does not get
            there, the point where |theta1| was largest.
        aim: what the root was solved for.
        best: the point by the cubic where the release was met last, if it was `found`.
        iterations: of the walk's last step, and those for the root.
        points, attempts, work: what was spent.
        crossings: met so far.
        status: of `Status`, once the search has ended.
    """

    walk: Walk
    root: Solved
    aim: Aim
    best: Float[Array, " D"]
    found: Scalar
    iterations: Scalar
    points: Scalar
    attempts: Scalar
    work: Scalar
    crossings: Scalar
    status: Scalar


def search(pendulum: Pendulum, slow: Scalar, wish: Wish, last: Aim) -> Search:
    """Follows a centred family from its normal mode to where it meets the wanted release, and
    solves for that (natural units).

    Without a ratio that is the `crossing`-th time that |theta1| = target; the orbit released at
    (-theta1, -theta2) is the same one, half a period later. The last correction runs in the walk's
    own loop: the corrector is compiled once.

    Arguments:
        last: how the wanted release is solved for; its point and row are put in here.
    """
    arc = arc_of("centred")

    def attempt(s: Search) -> Search:
        final = s.status == _LOCATED
        aim = jax.tree.map(partial(jnp.where, final), _aim_at(s, wish, last), s.aim)
        walk, new, taken, end = take_step(
            pendulum, s.walk, jnp.asarray(LONGEST_STEP), arc, (final, aim)
        )
        steps = jnp.where(final, aim.steps, s.walk.steps)
        work = s.work + new.iterations * steps
        s = s._replace(aim=aim, attempts=s.attempts + 1, work=work)
        walked = _after_step(s, walk, new, end, wish)
        refused = s._replace(walk=walk, status=jnp.where(end == 2, Status.LEFT_BRANCH, s.status))
        walked = jax.tree.map(partial(jnp.where, taken), walked, refused)
        solved = s._replace(
            root=new, iterations=s.iterations + new.iterations, status=_judge_root(s, new)
        )
        return jax.tree.map(partial(jnp.where, final), solved, _bound(walked))

    start = _start(pendulum, slow, wish, last)
    return lax.while_loop(lambda s: s.status < 0, attempt, start)


def _start(pendulum: Pendulum, slow: Scalar, wish: Wish, last: Aim) -> Search:
    begin, zero = start_at_mode(pendulum, slow), jnp.asarray(0)
    finite = jnp.isfinite(wish.target + jnp.sum(begin.point) + jnp.sum(begin.tangent))
    aim = jax.tree.map(
        jnp.asarray, last._replace(predicted=begin.point, row=jnp.zeros(UNKNOWNS), steps=zero)
    )
    return Search(
        walk=begin,
        root=no_point()._replace(point=begin.point),
        aim=aim,
        best=begin.point,
        found=jnp.asarray(False),
        iterations=zero,
        points=zero,
        attempts=zero,
        work=zero,
        crossings=zero,
        status=jnp.where(finite, _WALKING, Status.NONFINITE),
    )


def _after_step(s: Search, walk: Walk, new: Solved, end: Scalar, wish: Wish) -> Search:
    """The search after a step that was taken, whose cubic has been looked at for the release."""
    further = jnp.abs(new.point[0]) > jnp.abs(s.root.point[0])
    s = s._replace(
        walk=walk,
        root=jax.tree.map(partial(jnp.where, further), new, s.root),
        iterations=new.iterations,
        points=s.points + 1,
        status=jnp.where(
            end == 1, jnp.where(s.found, _LOCATED, int(Status.NO_SUCH_ORBIT)), _WALKING
        ),
    )
    return _look(s, wish)


def _bound(s: Search) -> Search:
    """The search, given up where it has cost too much."""
    over = (s.points >= _MOST_POINTS) | (s.attempts >= _MOST_ATTEMPTS) | (s.work >= _MOST_WORK)
    return s._replace(status=jnp.where((s.status == _WALKING) & over, Status.LEFT_BRANCH, s.status))


def _look(s: Search, wish: Wish) -> Search:
    """The search after its newest step has been looked at for the wanted release."""
    w = s.walk

    def at(share: Scalar) -> Array:
        return hermite(w.behind, w.behind_tangent, w.point, w.tangent, w.length, share)

    points = jax.vmap(at)(jnp.arange(_PIECES + 1) / _PIECES)
    values = jax.vmap(wish.miss)(points)
    changes = values[:-1] * values[1:] < 0
    seen = s.crossings + jnp.cumsum(changes)
    away = jnp.where(changes, jnp.abs(jnp.abs(points[1:, 0]) - wish.target), jnp.inf)
    closer = jnp.min(away) < jnp.where(s.found, _apart(s.best, wish), jnp.inf)
    nearest = (jnp.arange(_PIECES) == jnp.argmin(away)) & closer
    here = jnp.where(wish.ratio == 0, changes & (seen == wish.crossing), nearest)
    hit = jnp.any(here)
    left = jnp.argmax(here) / _PIECES
    sign = jnp.sign(wish.miss(at(left)))

    def halve(_: Scalar, bounds: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = bounds
        middle = 0.5 * (low + high)
        before = wish.miss(at(middle)) * sign > 0
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    low, high = lax.fori_loop(0, _HALVINGS, halve, (left, left + 1 / _PIECES))
    best = jnp.where(hit, at(0.5 * (low + high)), s.best)
    found = s.found | hit
    # With a ratio, further on only a branch that turned back could come nearer to the target.
    beyond = found & (jnp.abs(w.point[0]) - wish.target > _apart(best, wish))
    over = jnp.where(wish.ratio == 0, hit, beyond)
    status = jnp.where(over, _LOCATED, s.status)
    return s._replace(crossings=seen[-1], best=best, found=found, status=status)


def _apart(point: Array, wish: Wish) -> Scalar:
    return jnp.abs(jnp.abs(point[0]) - wish.target)


def _aim_at(s: Search, wish: Wish, last: Aim) -> Aim:
    """The located release as an aim: the row is theta1, or theta2 - ratio theta1."""
    at_angle = wish.ratio == 0
    # Rounding puts the cubic's point off where the target is tiny, and all of it is then as small.
    scale = jnp.where(at_angle, wish.target / jnp.abs(s.best[0]), 1.0)
    nodes = jnp.arange(UNKNOWNS) < UNKNOWNS - 2
    point = jnp.where(nodes, scale * s.best, s.best)
    angle = jnp.where(at_angle, jnp.sign(point[0]) * wish.target, point[0])
    other = jnp.where(at_angle, point[1], wish.ratio * point[0])
    row = jnp.where(at_angle, THETA1, THETA2 - wish.ratio * THETA1)
    steps = jnp.ceil(s.walk.steps * last.steps)
    return last._replace(
        predicted=point.at[0].set(angle).at[1].set(other),
        row=row,
        steps=jnp.clip(steps, 1, MOST_SEGMENT_STEPS).astype(int),
        amplitude=jnp.minimum(1.0, jnp.max(jnp.abs(point[:2]))),
        fixed=row,
        asked=jnp.where(at_angle, THETA2, THETA1),
    )


def _judge_root(s: Search, root: Solved) -> Scalar:
    """The status of the wanted orbit: a root far from the cubic is another orbit."""
    way = root.point - s.aim.predicted
    strayed = jnp.sqrt(way @ (METRIC * way)) > STRAYED * s.walk.length
    status = jnp.where(root.converged, int(Status.CONVERGED), int(Status.MAX_ITERATIONS))
    status = jnp.where(root.converged & strayed, Status.LEFT_BRANCH, status)
    return jnp.where(jnp.isfinite(root.miss), status, Status.NONFINITE)


def last_aim(turn: Scalar, tolerance: Scalar, max_iterations: Scalar) -> Aim:
    """How the wanted release is solved for, its point and row not known yet.

    `steps` is the factor by which a segment takes more steps than on the walk.
    """
    steps = TURN / turn
    return Aim(None, None, steps, _LAST_UPDATE * jnp.sqrt(tolerance), 1.0, max_iterations)
