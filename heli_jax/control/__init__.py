"""Controllers of identified vehicles: laws, closed loops, margins, and tuning over a posterior."""

from heli_jax.control.controller import Controller as Controller
from heli_jax.control.controller import begin as begin
from heli_jax.control.controller import commands as commands
from heli_jax.control.controller import with_controller as with_controller
from heli_jax.control.laws import Cascade as Cascade
from heli_jax.control.laws import Loop as Loop
from heli_jax.control.laws import Observer as Observer
from heli_jax.control.laws import StateFeedback as StateFeedback
from heli_jax.control.loops import loop_margins as loop_margins
from heli_jax.control.loops import plant_of as plant_of
from heli_jax.control.loops import sampled_loop as sampled_loop
from heli_jax.control.posterior import SteadyFlights as SteadyFlights
from heli_jax.control.posterior import draws as draws
from heli_jax.control.posterior import vehicles_of as vehicles_of
from heli_jax.control.regulators import lqg as lqg
from heli_jax.control.regulators import lqr as lqr
from heli_jax.control.regulators import pid as pid
from heli_jax.control.tune import Scenario as Scenario
from heli_jax.control.tune import Tuning as Tuning
from heli_jax.control.tune import tune as tune
