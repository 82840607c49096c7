"""The colours of all pictures: of figures, of TensorBoard and of pages."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable

#: Of methods: Okabe and Ito's colours, which the colour-blind can distinguish too; grey comes first, for the baseline.
METHOD_COLOURS = ("#555555", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
#: Of mappings and of what they map to: the same colours in an order in which neighbours differ most, then Tol's muted ones.
MAPPING_COLOURS = (
    *("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#555555"),
    *("#332288", "#882255", "#999933", "#AA4499", "#661100", "#44AA99", "#DDCC77", "#6699CC"),
)
#: Of the target's own actions: Tol's light colours, so that they are not taken for mappings.
ACTION_COLOURS = ("#77AADD", "#EE8866", "#EEDD88", "#FFAABB", "#44BB99", "#99DDFF", "#AAAA00", "#DDDDDD")
#: Where there is nothing.
NONE_COLOUR = "#EEEEEE"
#: The golden ratio: hues at its multiples never come close to each other.
GOLDEN = 0.618034
#: Names of no mapping.
NO_MAPPING = ("nothing", "nothing was transferred", "")


def colour(number: int, colours: tuple[str, ...] = MAPPING_COLOURS) -> str:
    """Return the colour with this number; where there are more than are listed, hues that lie far apart."""
    if number < len(colours):
        return colours[number]
    rgb = colorsys.hsv_to_rgb(number * GOLDEN % 1.0, 0.45, 0.8)
    return "#" + "".join(f"{round(255 * part):02X}" for part in rgb)


def mapping_colours(names: Iterable[str]) -> dict[str, str]:
    """Give each mapping a colour, by name: in the order in which they came up, so that a later one changes none before it."""
    different = [name for name in dict.fromkeys(names) if name not in NO_MAPPING]
    return {**dict.fromkeys(NO_MAPPING, NONE_COLOUR), **{name: colour(k) for k, name in enumerate(different)}}


def method_colours(names: Iterable[str], baseline: str) -> dict[str, str]:
    """Give each method a colour, by name: the baseline grey."""
    others = [name for name in dict.fromkeys(names) if name != baseline]
    return {baseline: METHOD_COLOURS[0], **{name: colour(k, METHOD_COLOURS[1:]) for k, name in enumerate(others)}}
