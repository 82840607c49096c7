"""All constants that decide behaviour: what each means, its unit, and the gate (``docs/results/learner.md``) that it serves.

What a user may choose is an argument of :class:`~sb3_combrel.FittedRMax`, with its default in ``fitted_rmax.settings``.
Tolerances of arithmetic stand where they are used.
"""

# On the slopes of a fit, in weights of instances a breadth away: MountainCar4D, Acrobot.
RIDGE = 0.001
# A pair of the grid is fitted anew when new instances may have changed its prediction by this part of the mean effect of its
# action, or when half of its list is new: speed, MountainCar4D, arm.
MAX_SURPRISE = 0.4
# A difference is measured by the mean effect of the action, but by no less than this part of a cell; and an instance changes a
# fit by its weight over this part of a full list, which is what the kernel's weights over one add up to: the same.
LEAST_SIZE, SHARE_OF_LIST = 0.01, 0.3
# An action is held until its cell of the grid is left, but no more steps than this: Acrobot, CartPole.
MAX_MODEL_STEPS = 50
# Of an agent that has stayed in a cell for so many steps: the part of what they have cost that its value must have risen by.
# In between all and nothing: point robot without noise, MountainCar4D with a source of 3,000 instances.
KEPT = 0.5
# Full sweeps over the grid after each step, and at an episode's end, or of a source: MountainCar4D, speed.
SWEEPS_A_STEP, SWEEPS_AT_EPISODE_END = 2, 300
# Lowest return that a state is given, in steps of the worst reward seen, far below every sensible plan: all rows.
LONGEST_PLAN = 10_000
# Scales that are found: what an observation may lie beyond them by, in parts of the range; and a range that is more times as
# wide as what is observed is too wide: CartPole, Acrobot, dm_control's pendulum.
BEYOND, TOO_WIDE = 0.05, 2.0
# Where a task goes on for ever, the lines of a grid of so many cells of a variable, or fewer, are where its values are wrong,
# and go half of the way there whenever instances are so many times as many: dm_control's cart-pole.
COARSE, LINES_AGAIN = 8, 1.25
# The action decides how episodes end, or where it leads does again, once it has foretold ends better by so many standard
# errors, far more than chance makes: bandits, selling.
SURE_OF_ENDS = 4.0
# Grid points are known with this fraction of the weight that exact states need, once an episode has ended or rewards have
# differed: nobody gets to those that lie beyond all data, and they would draw the agent for ever. Until then to know how
# states change is not to know what is there: dm_control's pendulum, point robot.
ON_GRID = 0.5
