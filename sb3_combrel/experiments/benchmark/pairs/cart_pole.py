"""CartPole-v1 to a pole of twice the length, whose variables stand in another order."""

import functools

from sb3_combrel import FactoredMapping
from sb3_combrel.experiments import cart_pole
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.experiments.suite_tasks import CART_POLE

PAIR = Pair(
    name="cart-pole",
    description="CartPole-v1 to a pole of twice the length, variables in another order. Known but for the length.",
    sources=(CART_POLE,),
    target=functools.partial(cart_pole.make_cart_pole, cart_pole.LONG, cart_pole.ORDER),
    n_steps=5000,
    threshold=195.0,
    learner=cart_pole.LONG_LEARNER,
    known=FactoredMapping((cart_pole.right_mapping(),)),
    known_by_action=cart_pole.right_mapping(),
)
