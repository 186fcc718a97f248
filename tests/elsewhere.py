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


@jax.jit
def monodromy(orbit, part, steps=1600):
    """The derivative of the flow over `part` of the period, in one piece of so many steps."""
    return transition(
        orbit.pendulum, orbit.state, part * orbit.period / steps, steps, dpend.Scheme("rk8", 1.0)
    )[1]
