"""Ant colony optimisation on a graph of possible values (paper 004, III.C). The functions have no
side effects; random generator and objective are arguments.

Each variable ("vertex") has a list of possible values ("positions"). An ant goes from vertex to
vertex and chooses one position at each; its path is one vector of values.

    M_vj = τ_vj^α · η_vj^θ₀ / Σ_{r ∈ A} τ_vr^α · η_vr^θ₀        (31) probability of a position
    τ_vj ← (1 − ρ)·τ_vj + Δτ_vj,   Δτ = Σ over depositing ants   (32)

    symbol  name                                        shape    unit
    v, j    vertex; position at it                               -
    τ       pheromone                                   (V, K)   -
    η       visibility: prior preference of a position  (V, K)   -
    A       positions that exist at the vertex          (V, K)   -
    ρ       evaporation per iteration                            -
    α, θ₀   exponents of pheromone and of visibility             -

Departures from the paper. The paper calls .284 the residual of the pheromone, but inserts it in
(32) as the evaporation ρ. Here .284 is the share that remains after an iteration, so ρ = 1 − .284 =
.716. With this faster evaporation the colony learns within few iterations. Pheromone belongs to
(vertex, position), not to edges, because the objective depends on positions and not on their
sequence. Deposits depend on the rank of an ant, so the scale of the objective does not matter. The
best path so far also receives a deposit. Pheromone stays within bounds, so the colony cannot
stagnate. (These are the rank-based, elitist and max-min ant systems.)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from edge_agent.lab.tuning.search import Graph, Ledger, Problem, Progress, Result, nearest_path
from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray, IntArray

# Upper limit of pheromone: the deposits of an iteration sum to ρ per vertex, so pheromone converges
# to at most 1.
HIGHEST = 1.0


@dataclass(frozen=True)
class Habits:
    """Parameters of the ant colony: exponents of pheromone (learned preference) and of visibility
    (prior preference), evaporation, and deposits.

    Raises:
        InputError: a parameter is out of its range.
    """

    alpha: float = 1.0  # weight of pheromone, α
    theta: float = 1.0  # weight of visibility, θ₀
    evaporation: float = 0.716  # ρ; the paper's residual of pheromone is 1 − ρ = 0.284
    elite: float = 0.25  # share of the ants of an iteration that deposit pheromone
    memory: float = 0.4  # share of the deposit that the best path so far receives
    retrace: float = 0.3  # probability that an ant of a converged colony repeats the best path
    # function that is called with the pheromone (V, K) after each iteration
    trace: Callable[[FloatArray], None] | None = None

    def __post_init__(self) -> None:
        """Reject parameters that are out of range, for example negative weights or an evaporation
        above 1.
        """
        for name in ("evaporation", "elite", "memory", "retrace"):
            value = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise InputError(name, f"{value} is not a share", "use a number between 0 and 1")
        for name in ("alpha", "theta"):
            if getattr(self, name) < 0.0:
                raise InputError(
                    name, "negative: the ants would avoid good choices", "use 0 or more"
                )


def transition_probabilities(
    pheromone: FloatArray,
    visibility: FloatArray,
    reachable: BoolArray,
    *,
    alpha: float,
    theta: float,
) -> FloatArray:
    """Return the probabilities (V, K) with which an ant chooses the positions (possible values) of
    all V vertices (variables), by equation (31) of paper 004. The probability is proportional to
    pheromone^alpha * visibility^theta, and zero where no position exists. Each row sums to one.
    """
    attraction = np.where(reachable, pheromone**alpha * visibility**theta, 0.0)
    probabilities: FloatArray = attraction / attraction.sum(axis=1, keepdims=True)
    return probabilities


def lowest_pheromone(reachable: BoolArray, retrace: float) -> FloatArray:
    """Return τ_min (V, 1), the lower bound of the pheromone for V vertices (variables). With this
    bound, an ant of a converged colony repeats the best path with probability `retrace`.

    The ant must choose the best position (value) of each vertex with the probability p =
    retrace^(1/V) = τ_max / (τ_max + (K − 1)·τ_min). The function solves this equation for τ_min.
    """
    vertices = len(reachable)
    p = retrace ** (1.0 / vertices)
    other_count = np.maximum(reachable.sum(axis=1, keepdims=True) - 1, 1)
    lowest: FloatArray = np.minimum(HIGHEST * (1.0 - p) / (other_count * p), HIGHEST)
    return lowest


def deposit_pheromone(paths: IntArray, weights: FloatArray, reachable: BoolArray) -> FloatArray:
    """Return the pheromone Δτ (V, K) that P paths (P, V) deposit on V vertices (variables) with K
    positions (values) each. At every vertex, path p adds the amount weights[p] at the position that
    it selects.
    """
    laid = np.zeros(reachable.shape)
    vertices = np.arange(reachable.shape[0])
    for path, weight in zip(paths, weights, strict=True):
        laid[vertices, path] += weight
    return laid


def renew_pheromone(
    pheromone: FloatArray,
    laid: FloatArray,
    reachable: BoolArray,
    *,
    evaporation: float,
    retrace: float,
) -> FloatArray:
    """Return the pheromone (V, K) after evaporation and the deposits `laid` (V, K), by equation
    (32) of paper 004. The result is limited to the range from τ_min to 1. A vertex (variable) may
    have fewer than K positions (possible values). The pheromone of the missing positions is zero.
    """
    renewed = (1.0 - evaporation) * pheromone + laid
    return np.where(reachable, np.clip(renewed, lowest_pheromone(reachable, retrace), HIGHEST), 0.0)


def _walk_ant(probabilities: FloatArray, rng: np.random.Generator) -> IntArray:
    """Return the path of one ant, (V,): the index of a position (possible value) for each vertex
    (variable). It is drawn at random with `probabilities` (V, K), the result of
    `transition_probabilities`.
    """
    reached = np.cumsum(probabilities, axis=1)
    drawn = rng.random((len(probabilities), 1)) * reached[:, -1:]
    path: IntArray = np.argmax(reached > drawn, axis=1)
    return path


def _rank_weights(ants: int, habits: Habits) -> FloatArray:
    """Return the amounts of pheromone (P,) that the best ants of an iteration deposit, by rank.
    Together with the deposit of the best path so far, these amounts sum to ρ, the share of
    pheromone that evaporates per iteration.
    """
    count = max(1, round(habits.elite * ants))
    ranks = np.arange(count, 0, -1, dtype=np.float64)
    weights: FloatArray = (1.0 - habits.memory) * habits.evaporation * ranks / ranks.sum()
    return weights


def optimise(
    problem: Problem,
    *,
    ants: int,
    iterations: int,
    rng: np.random.Generator,
    progress: Progress | None = None,
    habits: Habits | None = None,
) -> Result:
    """Search for the vector with the largest objective.

    Each vertex (variable) has a list of positions (possible values). `problem.visibility` may state
    a prior preference among them. The objective is called at most ants·iterations times, at most
    once for each vector.

    Raises:
        InputError: a vertex has no position, or there are no ants or no iterations.
    """
    habits = habits or Habits()
    graph = Graph.from_choices(problem.choices)
    reachable = graph.reachable
    ledger = Ledger(problem.objective, graph, problem.admissible)
    eta = (
        np.ones(reachable.shape)
        if problem.visibility is None
        else np.nan_to_num(Graph.from_choices(problem.visibility).positions, nan=1.0)
    )
    pheromone = np.where(reachable, HIGHEST, 0.0)
    weights = _rank_weights(ants, habits)

    for iteration in range(iterations):
        odds = transition_probabilities(
            pheromone, eta, reachable, alpha=habits.alpha, theta=habits.theta
        )
        paths = [ledger.draw(partial(_walk_ant, odds, rng)) for _ in range(ants)]
        if iteration == 0 and problem.start is not None:
            paths[0] = nearest_path(graph, problem.start)
        values = [ledger.evaluate(path) for path in paths]
        ledger.record(values, progress)
        pheromone = renew_pheromone(
            pheromone,
            _laid_pheromone(paths, values, weights, ledger, habits),
            reachable,
            evaporation=habits.evaporation,
            retrace=habits.retrace,
        )
        if habits.trace is not None:
            habits.trace(pheromone.copy())
    return ledger.result()


def _laid_pheromone(
    paths: list[IntArray], values: list[float], weights: FloatArray, ledger: Ledger, habits: Habits
) -> FloatArray:
    """Return the pheromone Δτ (V, K) that the colony deposits after one iteration. The best ants of
    the iteration deposit on their `paths` by rank of their `values`, and the best path so far
    receives a fixed share.
    """
    order = np.argsort(-np.asarray(values), kind="stable")[: len(weights)]
    best = ledger.best_path if ledger.best_path is not None else paths[0]
    depositing = np.array([paths[ant] for ant in order] + [best])
    amounts = np.append(weights, habits.memory * habits.evaporation)
    return deposit_pheromone(depositing, amounts, ledger.graph.reachable)
