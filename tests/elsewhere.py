"""What tests hold results to: values computed elsewhere, and derivatives in one piece."""

import jax

import dpend
from dpend.orbits.stability import transition

# The paper's pendulum released at 40 deg: theta2 [deg] and period of every return within 1 s, as
# scanned elsewhere on 40 000 values of theta2; two of them are the second return of another.
FORTY = [
    (-157.229758666, 0.789605931),
    (-157.229758666, 1.579211862),
    (-152.332774219, 1.970160641),
    (-151.107616659, 1.923779041),
    (-51.139513966, 0.754418866),
    (-51.139513966, 1.508837732),
    (-4.570287296, 1.174420237),
    (49.066544774, 1.212756333),
    (119.491215917, 1.283263044),
    (177.345987867, 1.451903639),
]

# Every passage of (0, 0) or (0, pi) at E = 0, m = l = g = 1, whose motion comes back within 10: the
# period, whether the lower rod is upright, the direction phi of p = L (cos phi, sin phi) sqrt(2 K)
# with L L^T the inertia, and theta(T/2) - theta(0) over pi. By a scan of 6000 directions and single
# shooting.
PASSAGES = [
    (2.9534890, 0, 1.7164240, (0, 1)),
    (2.9534890, 1, 1.5573697, (0, 1)),
    (5.9748176, 1, 0.4287103, (0, 0)),
    (6.6220871, 0, 2.0965804, (0, 1)),
    (6.6220871, 1, 0.5595415, (0, 1)),
    (7.7821052, 0, 2.2099636, (0, 0)),
    (7.9671587, 0, 1.4444102, (0, 1)),
    (7.9671587, 1, 0.3654138, (0, -1)),
    (8.5747274, 0, 1.5130226, (0, 2)),
    (8.5747274, 0, 2.0571742, (0, 2)),
    (9.4257937, 0, 0.6536010, (0, 0)),
    (9.4278183, 0, 0.2717752, (0, 0)),
    (9.4278183, 0, 1.1804949, (0, 0)),
    (9.8915271, 0, 1.3959157, (0, 0)),
]


@jax.jit
def monodromy(orbit, part, steps=1600):
    """The derivative of the flow over `part` of the period, in one piece of so many steps."""
    return transition(
        orbit.pendulum, orbit.state, part * orbit.period / steps, steps, dpend.Scheme("rk8", 1.0)
    )[1]
