"""How broad the kernel is that decides what is known, as long as no outcome has told states apart."""

from __future__ import annotations

import numpy as np


class Search:
    """Narrows the kernel where everything is known and nothing has been found.

    Until an episode ends or a reward is another one, nobody knows how small the place is that is looked for. An agent that
    knows all states by a kernel that is too broad for it would do the same for ever. So after an episode in which nothing was
    unknown, nor anything left to explore, the kernel's volume is halved: about twice as many visits are needed then, and no
    search takes much more than twice the visits that were necessary. Once outcomes differ the kernel is as broad again as it
    was.
    """

    def __init__(self) -> None:
        self.n_halvings = 0
        #: Environments in whose present episode something was unknown.
        self.met_unknown: set[int] = set()

    def breadth(self, breadth: float, n_variables: int) -> float:
        """What the kernel's breadth, unit coordinates, has become."""
        return float(breadth * 0.5 ** (self.n_halvings / n_variables))

    def end_episode(self, environment: int, goes_on: bool) -> bool:
        """Halve the kernel's volume if all was known and nothing found; whether it has another breadth now.

        :param goes_on: whether outcomes differ, or something is left to explore
        """
        all_known = environment not in self.met_unknown
        self.met_unknown.discard(environment)
        if goes_on or not all_known:
            return False
        self.n_halvings += 1
        # Episodes of other environments that are under way were of the broader kernel.
        self.met_unknown.clear()
        return True

    def get_state(self) -> dict[str, np.ndarray]:
        """Float64 arrays by name, for :meth:`set_state`."""
        met = np.array(sorted(self.met_unknown), dtype=np.float64).reshape(-1, 1)
        return {"n_halvings": np.array([float(self.n_halvings)]), "met_unknown": met}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`get_state` returned, whatever a file says."""
        self.n_halvings = int(np.clip(state["n_halvings"][0], 0, 1000))
        self.met_unknown = {int(row[0]) for row in state["met_unknown"]}
