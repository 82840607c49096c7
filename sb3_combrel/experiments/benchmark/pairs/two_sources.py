"""A cart and a pendulum are the sources of a cart that carries a pendulum."""

import functools

from sb3_combrel import FactoredMapping, InterTaskMapping
from sb3_combrel.experiments.benchmark.pair import Pair, recorded
from sb3_combrel.experiments.tasks.cart_with_pendulum import make_cart_with_pendulum

CART = recorded("cart", functools.partial(make_cart_with_pendulum, "cart"), n_instances=500, n_episodes=30)
PENDULUM = recorded("pendulum_alone", functools.partial(make_cart_with_pendulum, "pendulum"), n_episodes=50)

# Actions of the target: nothing, a push to either side, a torque in either direction.
OF_CART = InterTaskMapping(state=(0, 1, None, None), action=(0, 1, 2, 0, 0))
OF_PENDULUM = InterTaskMapping(state=(None, None, 0, 1), action=(0, 0, 0, 1, 2))

PAIR = Pair(
    name="two-sources",
    description=(
        "Two sources, a cart on a track and a pendulum with a motor, to a cart that carries the pendulum. Known but for the "
        "pull of the cart on the pendulum: each part is one of the sources, and an action moves one of them."
    ),
    sources=(CART, PENDULUM),
    target=make_cart_with_pendulum,
    n_steps=6000,
    threshold=-120.0,
    known=(FactoredMapping((OF_CART,)), FactoredMapping((OF_PENDULUM,))),
    known_by_action=(OF_CART, OF_CART, OF_CART, OF_PENDULUM, OF_PENDULUM),
    sources_by_action=(0, 0, 0, 1, 1),
)
