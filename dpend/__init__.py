"""A differentiable double pendulum, and the motions released from rest that come back.

Angles in radians, SI units. The public names are those below; each module's page says what it
computes and how.
"""

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

from dpend import _runtime as _runtime  # sets JAX up: before anything else
from dpend import chaos as chaos
from dpend._version import __version__ as __version__
from dpend.catalogue.atlas import Atlas as Atlas
from dpend.catalogue.atlas import Coverage as Coverage
from dpend.catalogue.atlas import load_atlas as load_atlas
from dpend.catalogue.energy import Census as Census
from dpend.catalogue.energy import find_orbits as find_orbits
from dpend.catalogue.release import find_brake_orbits as find_brake_orbits
from dpend.catalogue.survey import find_brake_families as find_brake_families
from dpend.inverse.design import Design as Design
from dpend.inverse.design import design_pendulum as design_pendulum
from dpend.inverse.estimates import Fit as Fit
from dpend.inverse.fit import fit_parameters as fit_parameters
from dpend.inverse.measurements import load_angles as load_angles
from dpend.machine import configure as configure
from dpend.maps.periodic import periodic_points as periodic_points
from dpend.maps.returns import Return as Return
from dpend.maps.returns import return_map as return_map
from dpend.maps.rotation import rotation_numbers as rotation_numbers
from dpend.maps.section import section as section
from dpend.maps.store import StoreWarning as StoreWarning
from dpend.maps.sweep import sweep as sweep
from dpend.mechanics.linear import Equilibria as Equilibria
from dpend.mechanics.linear import NormalMode as NormalMode
from dpend.mechanics.linear import equilibria as equilibria
from dpend.mechanics.linear import normal_modes as normal_modes
from dpend.mechanics.pendulum import BobEnergies as BobEnergies
from dpend.mechanics.pendulum import Pendulum as Pendulum
from dpend.mechanics.pendulum import Positions as Positions
from dpend.mechanics.pendulum import State as State
from dpend.mechanics.pendulum import energies as energies
from dpend.mechanics.pendulum import hamiltonian as hamiltonian
from dpend.mechanics.pendulum import momenta as momenta
from dpend.mechanics.pendulum import positions as positions
from dpend.mechanics.pendulum import released as released
from dpend.mechanics.pendulum import vector_field as vector_field
from dpend.mechanics.pendulum import velocities as velocities
from dpend.mechanics.surface import Plane as Plane
from dpend.mechanics.surface import on_energy as on_energy
from dpend.methods.scheme import Scheme as Scheme
from dpend.methods.scheme import scheme_for as scheme_for
from dpend.motion.crossings import Crossings as Crossings
from dpend.motion.crossings import crossings as crossings
from dpend.motion.events import Crossing as Crossing
from dpend.motion.events import first_crossing as first_crossing
from dpend.motion.gradients import GradientCheck as GradientCheck
from dpend.motion.gradients import GradientHorizon as GradientHorizon
from dpend.motion.gradients import check_gradient as check_gradient
from dpend.motion.gradients import gradient_horizon as gradient_horizon
from dpend.motion.integrate import flow as flow
from dpend.motion.integrate import fold as fold
from dpend.motion.reference import reference as reference
from dpend.motion.simulate import simulate as simulate
from dpend.motion.trajectory import Trajectory as Trajectory
from dpend.orbits.continuation import follow_family as follow_family
from dpend.orbits.family import Family as Family
from dpend.orbits.family_files import load_family as load_family
from dpend.orbits.family_files import save_family as save_family
from dpend.orbits.files import load_orbits as load_orbits
from dpend.orbits.files import save_orbits as save_orbits
from dpend.orbits.find import find_orbit as find_orbit
from dpend.orbits.orbit import PeriodicOrbit as PeriodicOrbit
from dpend.orbits.samples import SpecialPoint as SpecialPoint
from dpend.orbits.stability import monodromy as monodromy
from dpend.orbits.stability import multipliers as multipliers
from dpend.orbits.stability import stability_class as stability_class
from dpend.proofs.certificate import Certificate as Certificate
from dpend.proofs.certify import certify as certify
from dpend.proofs.complete import BrakeProof as BrakeProof
from dpend.proofs.complete import prove_brake_orbits as prove_brake_orbits
from dpend.proofs.ledger import certify_atlas as certify_atlas
from dpend.status import Status as Status
from dpend.status import message as message

if TYPE_CHECKING:
    from dpend import animate as animate
    from dpend import plots as plots


def __getattr__(name: str) -> ModuleType:
    """The pages that draw, imported when they are first asked for."""
    if name in ("plots", "animate"):
        return importlib.import_module(f"dpend.{name}")
    raise AttributeError(f"module 'dpend' has no attribute {name!r}")
