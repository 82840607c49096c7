"""What a place is worth to an agent that has found nothing yet."""

from __future__ import annotations

import numpy as np


def worth_after_visits(worth: np.ndarray, visits: np.ndarray, reward: float, gamma: float) -> np.ndarray:
    """What places are still worth: as if each lay one step further away for each visit to it.

    Until an episode ends or a reward is another one, nothing tells states apart but how often one has been there: R-Max would
    try each action at each of them, and then do the same for ever, however small the place is that is looked for. With this
    the agent goes where it has hardly been, tries what may lead there, and never stops searching. Where instances are
    transferred to the model, these tell states apart, and nothing is worth less.

    :param worth: what they are worth before the first visit, shape (n,)
    :param visits: the weight of the instances there, of all actions, shape (n,)
    :param reward: of every step so far
    """
    if gamma == 1.0:
        return worth + reward * visits
    for_ever = reward / (1.0 - gamma)
    return np.asarray(for_ever + gamma**visits * (worth - for_ever))
