"""What control needs of a network: a transition in pure JAX whose parameters are an argument.

Ground truth, posterior draws and point estimates are the same transition with other parameters; whoever gives
them is a `dtprob.inference.Sampler`.
"""

from collections.abc import Mapping
from typing import Any, Protocol

from jaxtyping import Array, Float, Int, PRNGKeyArray

type Parameters = Mapping[str, Float[Array, "..."]]


class State(Protocol):
    """Where the network stands at the start of a slot."""

    @property
    def buffer(self) -> Int[Array, " device"]:
        """Packets that wait."""
        ...

    @property
    def arrival(self) -> Int[Array, " device"]:
        """Whether a packet was generated at the end of the last slot."""
        ...

    @property
    def ack(self) -> Int[Array, " device"]:
        """Whether a packet was delivered in the last slot."""
        ...

    @property
    def slot(self) -> Int[Array, ""]:
        """Slots since the episode began."""
        ...


class Slot(Protocol):
    """What happened in a slot."""

    @property
    def delivered(self) -> Int[Array, " device"]:
        """Whether each device's packet got through."""
        ...

    @property
    def overflow(self) -> Int[Array, " device"]:
        """Whether each device lost a new packet because its buffer was full."""
        ...

    @property
    def collision(self) -> Array:
        """Whether some packet that was sent did not get through."""
        ...

    @property
    def reward(self) -> Float[Array, ""]:
        """The sum over devices."""
        ...


class Kernel(Protocol):
    """A transition; pure, hashable or a pytree, fit for jit, vmap and scan."""

    @property
    def devices(self) -> int:
        """Number of devices."""
        ...

    @property
    def capacity(self) -> int:
        """Packets that a buffer holds."""
        ...

    def initial(self) -> Any:
        """The `State` at the start of an episode."""
        ...

    def step(
        self, key: PRNGKeyArray, parameters: Parameters, state: Any, action: Int[Array, " device"]
    ) -> tuple[Any, Any]:
        """The next `State` and the `Slot`."""
        ...
