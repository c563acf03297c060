"""Is the flow past the cylinder right? Against pylbm to rounding, and against the literature.

    python benchmarks/flow_physics.py [--quick] [--json]     # some five minutes of one core

1. pylbm: one wake at Re 50 on a grid half as fine as the usual one, stirred by the turning cylinder
   and then left alone, in pylbm and in koop: the largest difference of the velocities anywhere,
   and the Strouhal numbers. Left out where `import pylbm` fails. Both have the same lattice, rates,
   equilibrium and boundaries; `pylbm_flow.SamePeer` says which of them pylbm had to be taught.
2. Literature, in the open: drag coefficient and length of the recirculation of the steady flow at
   Re 20 and 40, frequency of the wake at Re 50. Our walls are near, so that the cylinder fills a
   share b of the section and the stream passes it faster, by at most 1/(1 - b). What is measured
   and what that leaves of it bracket the drag in the open; the farther the walls, the closer. The
   frequency stays 1 to 3% above, since inlet and outlet are near, too. The wide domains have the
   grid that is half as fine, on which the recirculation is 5% short.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"  # read when numpy is imported
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pylbm_flow

from koop_clients.flow.cylinder import CylinderFlow
from koop_clients.flow.lattice import moments
from koop_clients.flow.settings import FlowSettings
from koop_clients.flow.walls import VELOCITIES

STREAMED = FlowSettings()
COARSE = FlowSettings(diameter=32 / 3, frame_steps=25)
WIDE = replace(COARSE, half_height=15.0, upstream=15.5, downstream=29.5)
WIDEST = replace(COARSE, half_height=30.0, upstream=15.5, downstream=29.5)

#: Frequency and strength at which the cylinder's turning wakes the wake, and for how long.
SHAKE, RATE, SHAKEN = 1.0, 0.13, 60.0  # U/D, U/D, D/U

#: What the literature has, lowest and highest: Dennis and Chang 1970, Coutanceau and Bouard 1977,
#: Fornberg 1980, Taira and Colonius 2007; the frequency: Williamson 1989.
KNOWN = {
    "drag at Re 20": (2.00, 2.06),
    "drag at Re 40": (1.50, 1.54),
    "recirculation at Re 20 [D]": (0.91, 0.94),
    "recirculation at Re 40 [D]": (2.13, 2.35),
    "Strouhal number at Re 50": (0.122, 0.124),
}

#: Power of the stream's speed that each grows with.
POWERS = {"drag": 2, "Strouhal": 1, "recirculation": 0}

_OPPOSITE = np.array([0, 3, 4, 1, 2, 7, 8, 5, 6])


def turning(time: float) -> float:
    """Rotation [U/D] at a time [D/U]."""
    return SHAKE * math.sin(2 * math.pi * RATE * time) if time < SHAKEN else 0.0


# Against pylbm


def against_pylbm(pylbm: Any, total: float) -> dict[str, float]:
    """The same flow in pylbm, and in koop in double and in single precision, for `total` [D/U]."""
    flows = {"double": CylinderFlow(COARSE, np.float64), "single": CylinderFlow(COARSE)}
    states = {name: flow.at_rest() for name, flow in flows.items()}
    peer, interval = pylbm_flow.SamePeer(pylbm, COARSE), COARSE.frame_time
    probes: dict[str, list[float]] = {"pylbm": [], "double": [], "single": []}
    found: dict[str, float] = {}
    count = math.ceil(total / interval)
    for number in range(count):
        rotation = turning(number * interval)
        peer.advance(COARSE.frame_steps, rotation)
        for name, flow in flows.items():
            states[name] = flow.frame(states[name], rotation)
            probes[name].append(flow.probe(states[name]))
        probes["pylbm"].append(_probe(peer.fields()[2]))
        if number + 1 in (math.ceil(SHAKEN / interval), count):
            when = "left" if number + 1 == count else "stirred"
            for name, flow in flows.items():
                found[f"pylbm_{when}_{name}"] = difference(flow, states[name], peer)
    tail = round(min(100.0, total - SHAKEN) / interval)
    for name, series in probes.items():
        found[f"strouhal_{name}"] = strouhal(np.array(series[-tail:]), interval)
    return found


def difference(flow: CylinderFlow, state: np.ndarray, peer: pylbm_flow.SamePeer) -> float:
    """Largest difference of a velocity anywhere [U]."""
    excess, mx, my = moments(state[:, 1:-1, 1:-1].astype(np.float64))
    ours = np.stack([mx, my]) / (1 + excess)
    fluid = ~flow.lattice.wall.solid[1:-1, 1:-1]
    return float(np.abs(ours - peer.fields()[1:])[:, fluid].max() / flow.settings.speed)


def _probe(v: np.ndarray) -> float:
    """Transverse velocity near the axis, some 2 D behind the cylinder [U]; without the rim."""
    x, y = COARSE.centre
    return float(v[int(y) - 1, round(x + 2.14 * COARSE.diameter) - 1] / COARSE.speed)


# Against the literature


def steady_flow(settings: FlowSettings, time: float = 80.0) -> tuple[CylinderFlow, np.ndarray]:
    """The steady flow at a Reynolds number below 47, where it is stable."""
    flow = CylinderFlow(settings)
    state = flow.at_rest()
    for _ in range(math.ceil(time / settings.frame_time)):
        state = flow.frame(state)
    return flow, state


def drag(flow: CylinderFlow, state: np.ndarray) -> float:
    """Drag coefficient of the cylinder at rest, by the momentum that its surface's links exchange.

    What goes out along a link comes back against it, as Bouzidi's rule has it. The populations'
    constant part pushes from all sides alike.
    """
    wall, state = flow.lattice.wall, state.astype(np.float64)
    rows, columns, i, q = wall.rows, wall.columns, wall.directions, wall.fractions
    c = VELOCITIES[i]
    there, back = state[i, rows, columns], state[_OPPOSITE[i], rows, columns]
    behind = state[i, rows - c[:, 1], columns - c[:, 0]]
    returned = np.where(
        q < 0.5, 2 * q * there + (1 - 2 * q) * behind, back + (there - back) / (2 * q)
    )
    force = (there + returned) @ c[:, 0]
    return float(force / (0.5 * flow.settings.speed**2 * flow.settings.diameter))


def recirculation(flow: CylinderFlow, state: np.ndarray) -> float:
    """How far behind the cylinder the flow on the axis turns back [D]."""
    (x, y), diameter = flow.settings.centre, flow.settings.diameter
    u = moments(state.astype(np.float64))[1][int(y) : int(y) + 2].mean(axis=0)
    first = math.ceil(x + diameter / 2)
    last = first + int(np.nonzero(u[first:] < 0)[0].max())
    crossing = last + u[last] / (u[last] - u[last + 1])
    return float((crossing - x) / diameter - 0.5)


def wake(settings: FlowSettings, total: float) -> tuple[float, float]:
    """Strouhal number of the wake after `total` [D/U], and how far it swings at the probe [U]."""
    flow, interval = CylinderFlow(settings), settings.frame_time
    state, probes = flow.at_rest(), []
    for number in range(math.ceil(total / interval)):
        state = flow.frame(state, turning(number * interval))
        probes.append(flow.probe(state))
    tail = np.array(probes[-round(100.0 / interval) :])
    return strouhal(tail, interval), float(np.abs(tail).max())


def strouhal(v: np.ndarray, interval: float) -> float:
    """Zero crossings upwards of `v` in a time [U/D]."""
    rises = np.nonzero((v[:-1] < 0) & (v[1:] >= 0))[0]
    times = (rises - v[rises] / (v[rises + 1] - v[rises])) * interval
    return float((len(times) - 1) / (times[-1] - times[0]))


def against_literature(quick: bool) -> dict[str, dict[str, float]]:
    """By domain, what `KNOWN` names."""
    domains = {"streamed": COARSE if quick else replace(STREAMED, frame_steps=50)}
    domains |= {} if quick else {"+-15": WIDE, "+-30": WIDEST}
    found: dict[str, dict[str, float]] = {}
    for name, settings in domains.items():
        mine = found[name] = {"blockage": 0.5 / settings.half_height}
        for reynolds in (20, 40):
            flow, state = steady_flow(replace(settings, reynolds=float(reynolds)))
            mine[f"drag at Re {reynolds}"] = drag(flow, state)
            mine[f"recirculation at Re {reynolds} [D]"] = recirculation(flow, state)
        mine["Strouhal number at Re 50"], mine["swing"] = wake(settings, 300.0)
    return found


# What is shown


def peer_table(found: dict[str, float]) -> str:
    lines = ["largest difference to pylbm of a velocity anywhere [U]    stirred    left alone"]
    for name in ("double", "single"):
        stirred, left = (found[f"pylbm_{when}_{name}"] for when in ("stirred", "left"))
        lines.append(f"  koop, {name} precision{'':31}{stirred:9.1e}{left:14.1e}")
    numbers = ", ".join(f"{n} {found[f'strouhal_{n}']:.5f}" for n in ("pylbm", "double", "single"))
    return "\n".join([*lines, f"Strouhal number: {numbers}"])


def literature_table(found: dict[str, dict[str, float]]) -> str:
    heads = [f"{name} (b = {domain['blockage']:.3f})" for name, domain in found.items()]
    lines = [_row("measured, and less the blockage", heads, "in the open")]
    for quantity, (low, high) in KNOWN.items():
        power = POWERS[quantity.split()[0]]
        cells = [
            f"{d[quantity]:.4g}, {d[quantity] * (1 - d['blockage']) ** power:.4g}"
            for d in found.values()
        ]
        lines.append(_row(quantity, cells, f"{low:g} to {high:g}"))
    swings = [f"{d['swing']:.3f}" for d in found.values()]
    return "\n".join([*lines, _row("swing of the wake at Re 50 [U]", swings, "")])


def _row(label: str, cells: list[str], last: str) -> str:
    return f"{label:34}{''.join(f'{cell:>24}' for cell in cells)}{last:>16}".rstrip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the streamed domain on a coarse grid")
    parser.add_argument("--json", action="store_true", help="end with one JSON object")
    options = parser.parse_args()
    pylbm, figures = pylbm_flow.load(), {}
    if isinstance(pylbm, str):
        print(pylbm)
    else:
        figures = against_pylbm(pylbm, 120.0 if options.quick else 300.0)
        print(peer_table(figures), end="\n\n", flush=True)
    found = against_literature(options.quick)
    print(literature_table(found))
    if options.json:
        print(json.dumps(figures | {"domains": found}))


if __name__ == "__main__":
    main()
