"""The networks that tests of control play on."""

import jax
import jax.numpy as jnp

from dtprob.control import Environment
from dtprob.physical.multi_access import Network, PhysicalKernel

NETWORK = Network.reference()
PAIR = Network.pairs(1)


def truth(network):
    """The network's tables as a pool of one draw."""
    return jax.tree.map(lambda table: jnp.asarray(table)[None], network.parameters)


def world(network, **settings):
    """An environment of the true network."""
    return Environment(PhysicalKernel.of(network), truth(network), **settings)
