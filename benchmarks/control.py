"""LQR with bounds (eq. 13): time from a model to checked controls, accuracy, and three peers.

Random affine models of 8 codes, history 2 and one control at the edge of stability, tracking random
targets. The bounds cut off the largest 40% of the unbounded controls. Everything runs on one core,
the peers in turn with koop on the same problems, the paper's eq. 13 without a weight of its own on
the end:

- the full form: ProxQP over codes and controls, the dynamics as equality constraints;
- scipy's L-BFGS-B on the condensed cost;
- the Riccati recursion, which knows no bounds.

Besides: bounds on the rate of a third of the bounds, the same at the next step from the last
solution, and the terminal weight of the infinite horizon.

    python benchmarks/control.py
"""

from __future__ import annotations

import argparse
import json
import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from proxsuite import proxqp
from scipy.optimize import minimize

from koop_service.control.problem import CondensedQP, build_lqr
from koop_service.control.riccati import lqr_riccati
from koop_service.control.solve import QPSolution, solve_qp
from koop_service.control.weights import LqrWeights, terminal_weight
from koop_service.prediction.model import LinearModel
from koop_service.prediction.rollout import rollout
from koop_service.prediction.uncertainty import rollout_std

Array = NDArray[np.float64]
Problem = TypeVar("Problem")

CODES, HISTORY, CONTROLS = 8, 2, 1
CONTROL_WEIGHT = 0.1
BOUNDED_SHARE = 0.4
FORECAST = 20


@dataclass(frozen=True)
class Case:
    """One control problem, with the bound that makes it hard enough."""

    model: LinearModel
    history: Array
    target: Array
    horizon: int
    bound: float

    def build(self) -> CondensedQP:
        return build_lqr(*self.arguments(), -self.bound, self.bound)

    def build_with_rates(self) -> CondensedQP:
        rates = {"du_min": -self.bound / 3, "du_max": self.bound / 3, "last_control": 0.0}
        return build_lqr(*self.arguments(), -self.bound, self.bound, **rates)

    def next(self, control: Array) -> Case:
        """The case one step later, of codes that are a little off the prediction."""
        code = rollout(self.model, self.history, control[None])
        noise = 1e-3 * np.random.default_rng(0).normal(size=code.shape)
        return replace(self, history=np.concatenate([self.history[1:], code + noise]))

    def arguments(self) -> tuple[LinearModel, Array, Array, int, float, float]:
        return self.model, self.history, self.target, self.horizon, 1.0, CONTROL_WEIGHT


def main() -> None:
    options = parse_options()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rng = np.random.default_rng(options.seed)
    short = [random_case(rng, 10) for _ in range(options.problems)]
    long = [random_case(rng, 40) for _ in range(options.problems)]
    figures = lqr_figures(short, "") | lqr_figures(long, "_n40") | peer_figures(short)
    figures |= rate_figures(short, "") | rate_figures(long, "_n40")
    figures |= accuracy_figures(short + long) | forecast_figures(short)
    print_table(figures)
    if options.json:
        print(json.dumps({name: float(f"{value:.4g}") for name, value in figures.items()}))


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", type=int, default=500, help="random problems a horizon")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="end with one JSON object on a line")
    return parser.parse_args()


def random_case(rng: np.random.Generator, horizon: int) -> Case:
    A = rng.normal(size=(CODES, CODES * HISTORY))
    B, c = rng.normal(size=(CODES, CONTROLS)), 0.1 * rng.normal(size=CODES)
    radius = LinearModel(A, B, c).spectral_radius()
    # Dividing the block of lag i by radius^i divides every pole by the radius.
    model = LinearModel(A / np.repeat(radius ** np.arange(HISTORY, 0, -1.0), CODES), B, c)
    history, target = rng.normal(size=(HISTORY, CODES)), rng.normal(size=CODES)
    free = lqr_riccati(model, history, target, horizon, 1.0, CONTROL_WEIGHT)
    return Case(
        model, history, target, horizon, float(np.quantile(np.abs(free), 1 - BOUNDED_SHARE))
    )


def koop(case: Case) -> QPSolution:
    """What the service does to answer: check the arguments, condense, solve, check the answer."""
    return solve_qp(case.build())


def koop_with_rates(case: Case) -> QPSolution:
    return solve_qp(case.build_with_rates())


def end_weight(case: Case) -> Array:
    weights = LqrWeights.parse(1.0, CONTROL_WEIGHT, CODES, CONTROLS)
    return terminal_weight(case.model, weights, "riccati")


def full_form(case: Case) -> Array:
    """The textbook way: codes and controls unknown, one dynamics constraint a step. Controls."""
    N, n, p = case.horizon, CODES, CONTROLS
    dynamics = np.zeros((N * n, N * (n + p)))
    constant = np.tile(case.model.c, N)
    for t in range(N):
        rows = slice(t * n, (t + 1) * n)
        dynamics[rows, rows] = np.eye(n)
        dynamics[rows, N * n + t * p : N * n + (t + 1) * p] = -case.model.B
        for lag in range(1, HISTORY + 1):
            block = case.model.A[:, (HISTORY - lag) * n : (HISTORY - lag + 1) * n]
            if t >= lag:
                dynamics[rows, (t - lag) * n : (t - lag + 1) * n] = -block
            else:
                constant[rows] += block @ case.history[t - lag]
    weights = np.concatenate([np.ones(N * n), np.full(N * p, CONTROL_WEIGHT)])
    slope = np.concatenate([np.tile(-2.0 * case.target, N), np.zeros(N * p)])
    bound = np.concatenate([np.full(N * n, np.inf), np.full(N * p, case.bound)])
    solver = proxqp.dense.QP(N * (n + p), N * n, 0, True)
    solver.settings.eps_abs = 1e-9
    solver.init(2.0 * np.diag(weights), slope, dynamics, constant, l_box=-bound, u_box=bound)
    solver.solve()
    return np.array(solver.results.x[N * n :]).reshape(N, p)


def scipy_condensed(case: Case) -> Array:
    """koop's condensed cost handed to scipy's bounded quasi-Newton method."""
    qp = case.build()
    found = minimize(
        lambda u: (qp.cost(u), qp.gradient(u)),
        np.zeros(len(qp.g)),
        jac=True,
        method="L-BFGS-B",
        bounds=np.column_stack([qp.lower, qp.upper]),
        options={"ftol": 1e-15, "gtol": 1e-9},
    )
    return found.x.reshape(-1, CONTROLS)


def riccati(case: Case) -> Array:
    return lqr_riccati(*case.arguments())


def milliseconds(function: Callable[[Problem], object], cases: list[Problem]) -> Array:
    """Time of each call, after a round to warm up."""
    for case in cases[:10]:
        function(case)
    times = np.empty(len(cases))
    for i, case in enumerate(cases):
        start = time.perf_counter_ns()
        function(case)
        times[i] = (time.perf_counter_ns() - start) * 1e-6
    return times


def lqr_figures(cases: list[Case], suffix: str) -> dict[str, float]:
    whole = np.concatenate([milliseconds(koop, cases) for _ in range(3)])
    building = milliseconds(Case.build, cases)
    solutions = [koop(case) for case in cases]
    on_bound = [np.abs(s.u) == case.bound for s, case in zip(solutions, cases, strict=True)]
    return {
        f"qp{suffix}_ms": float(np.median(whole)),
        f"qp{suffix}_p99_ms": float(np.quantile(whole, 0.99)),
        f"condensing{suffix}_ms": float(np.median(building)),
        f"active_share{suffix}": float(np.mean(on_bound)),
        f"kkt_max{suffix}": max(s.kkt_residual for s in solutions),
        f"unsolved{suffix}": sum(s.status != "solved" for s in solutions),
    }


def rate_figures(cases: list[Case], suffix: str) -> dict[str, float]:
    """With bounds on the rate; then at the next step, cold and from the last solution."""
    whole = np.concatenate([milliseconds(koop_with_rates, cases) for _ in range(3)])
    solutions = [koop_with_rates(case) for case in cases]
    pairs = [(case.next(last.u[0]).build(), last) for case in cases for last in [koop(case)]]
    nearly = [0.333 * case.bound for case in cases]
    active = [np.abs(np.diff(s.u[:, 0])) >= near for s, near in zip(solutions, nearly, strict=True)]
    warm = [solve_qp(qp, last) for qp, last in pairs]
    return {
        f"rates{suffix}_ms": float(np.median(whole)),
        f"rates{suffix}_p99_ms": float(np.quantile(whole, 0.99)),
        f"rates_active{suffix}": float(np.mean(active)),
        f"rates_kkt_max{suffix}": max(s.kkt_residual for s in solutions),
        f"rates_unsolved{suffix}": sum(s.status != "solved" for s in solutions),
        f"warm{suffix}_ms": float(np.median(milliseconds(lambda pair: solve_qp(*pair), pairs))),
        f"cold{suffix}_ms": float(np.median(milliseconds(lambda pair: solve_qp(pair[0]), pairs))),
        f"warm_share{suffix}": float(np.mean([s.warm for s in warm])),
        f"end_weight{suffix}_ms": float(np.median(milliseconds(end_weight, cases))),
    }


def peer_figures(cases: list[Case]) -> dict[str, float]:
    """Medians of koop and peers, in turn within each round, and how far their controls differ."""
    peers = {"koop": koop, "full_form": full_form, "scipy": scipy_condensed, "riccati": riccati}
    cases = cases[:100]
    rounds = [{name: milliseconds(peer, cases) for name, peer in peers.items()} for _ in range(3)]
    medians = {
        name: float(np.median(np.concatenate([times[name] for times in rounds]))) for name in peers
    }
    figures = {f"{name}_ms": medians[name] for name in peers if name != "koop"}
    for name in ("full_form", "scipy"):
        figures[f"ratio_{name}"] = medians[name] / medians["koop"]
        apart = (np.abs(koop(case).u - peers[name](case)).max() for case in cases)
        figures[f"difference_{name}"] = max(apart)
    return figures


def accuracy_figures(cases: list[Case]) -> dict[str, float]:
    """Largest difference to Riccati with bounds that are there but not active."""
    apart: list[float] = []
    for case in cases:
        u = riccati(case)
        wide = 1.5 * float(np.abs(u).max())
        solution = solve_qp(build_lqr(*case.arguments(), -wide, wide))
        apart.append(float(np.abs(solution.u - u).max()))
    return {"riccati_difference": max(apart)}


def forecast_figures(cases: list[Case]) -> dict[str, float]:
    """Rolling 20 steps ahead, and the standard deviations of that."""
    d = CODES * HISTORY + CONTROLS
    controls, S, R = np.ones((FORECAST, CONTROLS)), 1e-2 * np.eye(CODES), 10.0 * np.eye(d)

    def codes(case: Case) -> Array:
        return rollout(case.model, case.history, controls)

    def deviations(case: Case) -> Array:
        return rollout_std(case.model, case.history, controls, S, R)

    return {
        "rollout_ms": float(np.median(milliseconds(codes, cases))),
        "rollout_std_ms": float(np.median(milliseconds(deviations, cases))),
    }


def print_table(f: dict[str, float]) -> None:
    print(f"{'LQR, 8 codes, history 2, 1 control':44}{'N = 10':>12}{'N = 40':>12}")
    rows = {
        "condensing and solving, median [ms]": ("qp{}_ms", ".3f"),
        "  99th percentile [ms]": ("qp{}_p99_ms", ".3f"),
        "  of which condensing, median [ms]": ("condensing{}_ms", ".3f"),
        "controls on a bound": ("active_share{}", ".0%"),
        "largest KKT residual, relative": ("kkt_max{}", ".1e"),
        "problems not solved": ("unsolved{}", ".0f"),
        "with bounds on the rate, median [ms]": ("rates{}_ms", ".3f"),
        "  99th percentile with them [ms]": ("rates{}_p99_ms", ".3f"),
        "  changes on a bound": ("rates_active{}", ".0%"),
        "  largest KKT residual, relative": ("rates_kkt_max{}", ".1e"),
        "  problems not solved": ("rates_unsolved{}", ".0f"),
        "solving the next step, cold, median [ms]": ("cold{}_ms", ".3f"),
        "  from the last solution, median [ms]": ("warm{}_ms", ".3f"),
        "  share for which that was enough": ("warm_share{}", ".0%"),
        "terminal weight, median [ms]": ("end_weight{}_ms", ".3f"),
    }
    for label, (name, form) in rows.items():
        print(f"{label:44}{f[name.format('')]:>12{form}}{f[name.format('_n40')]:>12{form}}")
    print(f"{'largest difference to Riccati, not bounded':44}{f['riccati_difference']:>24.1e}")
    print(f"\n{'peers at N = 10':44}{'ms':>12}{'x koop':>12}{'difference':>12}")
    for label, name in (("ProxQP, codes and controls", "full_form"), ("L-BFGS-B", "scipy")):
        ratio, apart = f[f"ratio_{name}"], f[f"difference_{name}"]
        print(f"{label:44}{f[f'{name}_ms']:>12.3f}{ratio:>12.1f}{apart:>12.1e}")
    print(f"{'Riccati, no bounds':44}{f['riccati_ms']:>12.3f}")
    print(f"\n{'roll-out, 20 steps [ms]':44}{f['rollout_ms']:>12.3f}")
    print(f"{'  its standard deviations [ms]':44}{f['rollout_std_ms']:>12.3f}")


if __name__ == "__main__":
    main()
