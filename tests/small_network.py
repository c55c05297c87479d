"""A multi-access network of four devices, slot by slot in plain NumPy: the truth that tests of its twin see."""

import numpy as np

from dtprob.data import NetworkLog

CLUSTERS = ((0, 1), (2, 3))
ARRIVAL = np.array([0.2, 0.4, 0.4, 0.0])  # of none, the second, the first, both devices of a cluster
RECEPTION = {0: [1.0], 1: [0.0, 1.0], 2: [0.0, 0.8, 0.2], 3: [1.0], 4: [1.0]}


def simulate(slots, seed, *, arrival=(ARRIVAL, ARRIVAL), reception=RECEPTION, silent=(), episodes=1):
    """A log under random access; ``silent`` devices generate nothing.

    Every slot a transmit probability is drawn that all devices share.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for episode in range(episodes):
        buffer = np.zeros(4, int)
        for slot in range(slots):
            action = (rng.random(4) < rng.random()).astype(int)
            senders = np.flatnonzero((action > 0) & (buffer > 0))
            law = reception[len(senders)]
            count = rng.choice(len(law), p=law)
            ack = np.zeros(4, int)
            ack[rng.permutation(senders)[:count]] = 1
            new = np.zeros(4, int)
            for (first, second), law in zip(CLUSTERS, arrival, strict=True):
                outcome = rng.choice(4, p=law)
                new[first], new[second] = outcome // 2, outcome % 2
            new[list(silent)] = 0
            rows.append((episode, slot, buffer, action, ack, new))
            buffer = np.clip(buffer + new - ack, 0, 1)
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    names = ("episode", "slot", "buffer", "action", "ack", "arrival")
    return NetworkLog(**dict(zip(names, columns, strict=True)))
