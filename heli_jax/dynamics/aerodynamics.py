"""Forces and moments of the rotors."""

from heli_jax.naming import Scalar
from heli_jax.vehicle import Helicopter


def cyclic_moment(p: Helicopter, theta_cyc: Scalar) -> Scalar:
    r"""Roll or pitch moment of the rotor for a cyclic blade angle, eqs 14-15 [N m].

    $$M = \tfrac12 \rho \Omega^2 a c R^4 \theta_{cyc}$$

    The factor 1/2 is the named parameter `cyclic_moment`; blade-element theory averaged over a
    turn gives 1/8 for two blades, so an inertia found with 1/2 is a number of this model.
    """
    return p.cyclic_moment * p.rho * p.Omega**2 * p.a * p.c * p.R**4 * theta_cyc
