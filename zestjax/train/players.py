"""Several objectives over one tree, each minimised over its own part: what adversarial training is made of.

tree     a NamedTuple of the players' parts
said     terms that the players before this one reported in the same step
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


class Player(NamedTuple):
    """part: name of the field of the tree that is its own. objective: `objective(tree, batch, said, step) -> (total,
    terms)`, step the number of updates already made. solver: `solve.Adam`, or anything with its `init_state` and
    `apply`."""

    part: str
    objective: Callable
    solver: Any


class Turns(NamedTuple):
    """states: of the players' solvers."""

    states: tuple[Any, ...]

    @property
    def iter_num(self) -> jax.Array:
        """() updates already made."""
        return self.states[0].iter_num

    @property
    def skipped(self) -> jax.Array:
        """() updates that a solver left out, of all players."""
        return jnp.sum(jnp.stack([state.skipped for state in self.states]))


def alternate(*players: Player) -> tuple[Callable, Callable]:
    """A step in which the players move one after the other, each seeing where those before it have moved to.

    Args:
      players: in the order of their turns.

    Returns:
      (init(tree) -> `Turns`, step(tree, turns, batch) -> (tree, turns, terms)), pure. terms: all that the players
      report, `total` of the first, and the totals of the others by the names of their parts.
    """

    def init(tree):
        return Turns(tuple(player.solver.init_state(getattr(tree, player.part)) for player in players))

    def step(tree, turns, batch):
        said, states = {}, []
        for player, state in zip(players, turns.states, strict=True):
            tree, state, said = _turn(player, tree, state, batch, said)
            states.append(state)
        return tree, Turns(tuple(states)), said

    return init, step


def _turn(player, tree, state, batch, said):
    """One player's update of its part."""

    def mine(part):
        return player.objective(tree._replace(**{player.part: part}), batch, said, state.iter_num)

    part = getattr(tree, player.part)
    (total, terms), grads = jax.value_and_grad(mine, has_aux=True)(part)
    part, state = player.solver.apply(part, state, grads, total)
    return tree._replace(**{player.part: part}), state, said | terms | {"total" if not said else player.part: total}


def played(*players: Player) -> Callable:
    """`objective(tree, batch) -> (sum of the totals, terms)` at the first step: for a look at what is finite, and for
    its cost. No player minimises it."""

    def objective(tree, batch):
        said, whole = {}, 0.0
        for player in players:
            total, terms = player.objective(tree, batch, said, 0)
            said, whole = said | terms | {"total" if not said else player.part: total}, whole + total
        return whole, said

    return objective
