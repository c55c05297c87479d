"""COMA in PyTorch on plain PettingZoo environments; run by bench_control.py in an environment of its own.

    python benchmarks/rival_torch.py network.npz found.npz SLOTS

The networks, batches, returns, advantages and optimisers are those of `dtprob.control.COMA`, written as one writes
PyTorch: 32 environments are stepped one after the other, the policies of all devices act in one batched product, and
each update takes 20 slots of all of them. One thread. Writes training slots per second of processor time, and the mean
reward of the last tenth of the updates.
"""

import itertools
import sys
import time

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from plain_network import PlainNetwork
from torch import nn  # pyright: ignore[reportMissingImports]

ENVIRONMENTS, LENGTH, FRAME = 32, 20, 4
DISCOUNT, MIX, SCALE, REFRESH, CRITIC_STEPS = 0.95, 0.8, 100.0, 5, 2
RATE, ENTROPY, OWN = 5e-3, 0.05, 4


class Actors(nn.Module):
    """A network 3-32-32-4 with tanh for each device."""

    def __init__(self, devices: int) -> None:
        super().__init__()
        sizes = ((3, 32), (32, 32), (32, FRAME))
        self.weight = nn.ParameterList([(torch.rand(devices, *s) * 2 - 1) / s[0] ** 0.5 for s in sizes])
        self.bias = nn.ParameterList([(torch.rand(devices, 1, b) * 2 - 1) / a**0.5 for a, b in sizes])

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        """Log-odds of sending, (batch, device), from what is seen, (batch, device, 4)."""
        x = seen[..., :3].transpose(0, 1) * 2.0 - 1.0
        for layer, (weight, bias) in enumerate(zip(self.weight, self.bias, strict=True)):
            x = torch.baddbmm(bias, torch.tanh(x) if layer else x, weight)
        phase = (seen[..., 3].long() % FRAME).T[..., None]
        return x.gather(2, phase)[..., 0].T


class Critic(nn.Module):
    """Values of silence and sending of each device, given the actions of the others."""

    def __init__(self, devices: int) -> None:
        super().__init__()
        inputs = 3 + FRAME + OWN
        self.own = nn.Parameter(torch.randn(devices, OWN))
        self.selected, self.other = mlp(inputs, 32, 32, 16), mlp(inputs + 1, 32, 32, 16)
        self.head = mlp(32, 32, 2)

    def forward(self, seen: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """(batch, device, choice) from (batch, device, 4) and (batch, device)."""
        phase = nn.functional.one_hot(seen[..., 3].long() % FRAME, FRAME).float()
        own = self.own.expand(len(seen), -1, -1)
        x = torch.cat([phase, seen[..., :3] * 2.0 - 1.0, own], dim=-1)
        sends = (action * (seen[..., 0] > 0) * 2.0 - 1.0)[..., None]
        each = self.other(torch.cat([x, sends], dim=-1))
        rest = each.sum(1, keepdim=True) - each
        return self.head(torch.cat([self.selected(x), rest], dim=-1))


def mlp(*sizes: int) -> nn.Sequential:
    """Linear layers with rectifiers between them."""
    layers: list[nn.Module] = []
    for first, second in itertools.pairwise(sizes):
        layers += [nn.Linear(first, second), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class Worlds:
    """Environments side by side, one stepped after the other; episodes begin anew by themselves."""

    def __init__(self, network: dict) -> None:
        self.every = [PlainNetwork(**network) for _ in range(ENVIRONMENTS)]
        self.seen = np.array([list(env.reset(i)[0].values()) for i, env in enumerate(self.every)])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rewards and ends."""
        reward, ends = np.zeros(ENVIRONMENTS), np.zeros(ENVIRONMENTS, bool)
        for i, (env, row) in enumerate(zip(self.every, action.tolist(), strict=True)):
            seen, pay, _, cut, _ = env.step(dict(zip(env.agents, row, strict=True)))
            reward[i], ends[i] = pay[env.agents[0]], cut[env.agents[0]]
            if ends[i]:
                seen, _ = env.reset(int(env.random.integers(2**31)))
            self.seen[i] = list(seen.values())
        return reward, ends


def rollout(worlds: Worlds, actors: Actors) -> tuple[torch.Tensor, ...]:
    """Observations, actions, rewards, ends of some slots; leaves (slot, environment, ...)."""
    kept: list[tuple[torch.Tensor, ...]] = []
    for _ in range(LENGTH):
        seen = torch.tensor(worlds.seen, dtype=torch.float32)
        with torch.no_grad():
            action = torch.bernoulli(torch.sigmoid(actors(seen)))
        reward, ends = worlds.step(action.numpy())
        kept.append((seen, action, torch.tensor(reward, dtype=torch.float32), torch.tensor(ends)))
    return tuple(torch.stack(part) for part in zip(*kept, strict=True))


def returns(reward: torch.Tensor, value: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
    """TD(lambda) returns of every device, (slot, environment, device)."""
    found, following = torch.empty_like(value), value[-1]
    for slot in reversed(range(LENGTH)):
        after = (1 - MIX) * value[min(slot + 1, LENGTH - 1)] + MIX * following
        now = reward[slot][:, None] / SCALE + DISCOUNT * after
        following = torch.where(ends[slot][:, None] | torch.tensor(slot == LENGTH - 1), value[slot], now)
        found[slot] = following
    return found


def apply(optimiser: torch.optim.Optimizer, loss: torch.Tensor, rate: float) -> None:
    """One step of Adam with clipped gradients."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    for group in optimiser.param_groups:
        group["lr"] = rate
        nn.utils.clip_grad_value_(group["params"], 1.0)
    optimiser.step()


def train(network: dict, slots: int) -> tuple[float, float]:
    """Slots per second of processor time, and the mean reward of the last tenth of the updates."""
    torch.manual_seed(0)
    worlds, devices = Worlds(network), len(network["reception"]) - 1
    actors, critic, target = Actors(devices), Critic(devices), Critic(devices)
    target.load_state_dict(critic.state_dict())
    of_actors, of_critic = (torch.optim.Adam(module.parameters()) for module in (actors, critic))
    updates = slots // (ENVIRONMENTS * LENGTH)
    rewards: list[float] = []
    start = time.process_time()
    for update in range(updates):
        progress = update / updates
        rate = RATE * (1 - 0.9 * progress)
        seen, action, reward, ends = rollout(worlds, actors)
        rewards.append(float(reward.mean()))
        flat, acted = seen.flatten(0, 1), action.flatten(0, 1)
        chosen = acted.long()[..., None]
        with torch.no_grad():
            value = target(flat, acted).gather(2, chosen)[..., 0].view_as(action)
            aim = returns(reward, value, ends).flatten(0, 1)
            known = ~ends
            known[-1] = False
            weight = known.flatten()[:, None].float()
        for _ in range(CRITIC_STEPS):
            error = critic(flat, acted).gather(2, chosen)[..., 0] - aim
            apply(of_critic, (error**2 * weight).mean(), rate)
        logit = actors(flat)
        chance = torch.sigmoid(logit)
        with torch.no_grad():
            values = critic(flat, acted)
            average = (1 - chance) * values[..., 0] + chance * values[..., 1]
            advantage = values.gather(2, chosen)[..., 0] - average
            advantage /= advantage.square().mean().sqrt() + 1e-6
        law = torch.distributions.Bernoulli(logits=logit)
        gain = law.log_prob(acted) * advantage + ENTROPY * max(0.0, 1 - 1.5 * progress) * law.entropy()
        apply(of_actors, -((flat[..., 0] > 0) * gain).mean(), rate)
        if (update + 1) % REFRESH == 0:
            target.load_state_dict(critic.state_dict())
    spent = time.process_time() - start
    return updates * ENVIRONMENTS * LENGTH / spent, float(np.mean(rewards[-max(1, updates // 10) :]))


def main() -> None:
    """Read the network, play, train, write."""
    torch.set_num_threads(1)
    with np.load(sys.argv[1]) as file:
        network = {name: file[name] for name in file.files}
    network = {**network, "clusters": network["clusters"].tolist(), "capacity": int(network["capacity"])}
    slots = int(sys.argv[3])
    np.savez(sys.argv[2], training=train(network, slots))


if __name__ == "__main__":
    main()
