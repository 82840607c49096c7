"""CartPole-v1 to a longer pole, whose variables stand in another order."""

import functools

from sb3_combrel import FactoredMapping
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.suite.tasks import CART_POLE
from sb3_combrel.experiments.tasks import cart_pole

#: Half the length of the pole, 0.5 in CartPole-v1. With twice that, the right mapping would predict twice the angular effects
#: of a push, which is no better than none.
HALF_LENGTH = 0.7

PAIR = Pair(
    name="cart-pole",
    description="CartPole-v1 to a pole of 1.4 times the length, variables in another order. Known but for the length.",
    sources=(CART_POLE,),
    target=functools.partial(cart_pole.make_cart_pole, HALF_LENGTH, cart_pole.ORDER),
    n_steps=5000,
    threshold=400.0,
    learner=cart_pole.LONG_LEARNER,
    known=FactoredMapping((cart_pole.right_mapping(),)),
    known_by_action=cart_pole.right_mapping(),
)
