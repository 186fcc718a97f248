"""A differentiable double pendulum, and the motions released from rest that come back.

Angles in radians, SI units. The public names are those below; each module's page says what it computes and how.
"""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

from dpend import _runtime as _runtime  # sets JAX up: before anything else
from dpend import chaos as chaos
from dpend.atlas import Atlas as Atlas
from dpend.atlas import Coverage as Coverage
from dpend.atlas import find_brake_orbits as find_brake_orbits
from dpend.atlas import load_atlas as load_atlas
from dpend.design import Design as Design
from dpend.design import design_pendulum as design_pendulum
from dpend.events import Crossing as Crossing
from dpend.events import first_crossing as first_crossing
from dpend.families import Family as Family
from dpend.families import SpecialPoint as SpecialPoint
from dpend.families import follow_family as follow_family
from dpend.fit import Fit as Fit
from dpend.fit import fit_parameters as fit_parameters
from dpend.gradients import GradientCheck as GradientCheck
from dpend.gradients import GradientHorizon as GradientHorizon
from dpend.gradients import check_gradient as check_gradient
from dpend.gradients import gradient_horizon as gradient_horizon
from dpend.measurements import load_angles as load_angles
from dpend.orbits import PeriodicOrbit as PeriodicOrbit
from dpend.orbits import find_orbit as find_orbit
from dpend.pendulum import BobEnergies as BobEnergies
from dpend.pendulum import Equilibria as Equilibria
from dpend.pendulum import NormalMode as NormalMode
from dpend.pendulum import Pendulum as Pendulum
from dpend.pendulum import Positions as Positions
from dpend.pendulum import State as State
from dpend.pendulum import energies as energies
from dpend.pendulum import equilibria as equilibria
from dpend.pendulum import hamiltonian as hamiltonian
from dpend.pendulum import momenta as momenta
from dpend.pendulum import normal_modes as normal_modes
from dpend.pendulum import positions as positions
from dpend.pendulum import released as released
from dpend.pendulum import vector_field as vector_field
from dpend.pendulum import velocities as velocities
from dpend.stability import monodromy as monodromy
from dpend.stability import multipliers as multipliers
from dpend.stability import stability_class as stability_class
from dpend.steppers import Scheme as Scheme
from dpend.steppers import scheme_for as scheme_for
from dpend.survey import find_brake_families as find_brake_families
from dpend.sweeps import sweep as sweep
from dpend.trajectory import Status as Status
from dpend.trajectory import Trajectory as Trajectory
from dpend.trajectory import flow as flow
from dpend.trajectory import fold as fold
from dpend.trajectory import message as message
from dpend.trajectory import reference as reference
from dpend.trajectory import simulate as simulate

if TYPE_CHECKING:
    from dpend import animate as animate
    from dpend import plots as plots

__version__ = "0.1.0"


def __getattr__(name: str) -> ModuleType:
    """The pages that draw, imported when they are first asked for."""
    if name in ("plots", "animate"):
        return importlib.import_module(f"dpend.{name}")
    raise AttributeError(f"module 'dpend' has no attribute {name!r}")
