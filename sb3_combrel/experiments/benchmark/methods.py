"""The methods of the benchmark, by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from sb3_combrel import (
    COMBREL,
    MASTER,
    TIMBREL,
    FactoredMapping,
    MappingExperts,
    SampleTransfer,
    SoftHomomorphism,
    SourceInstances,
    SparseCodingMapping,
    ThreeWayRBM,
)
from sb3_combrel.experiments.benchmark.oracle import KnownCopies
from sb3_combrel.experiments.benchmark.pair import Pair, check_name
from sb3_combrel.experiments.benchmark.third_party import load_attribute
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.methods.learned_translation import DEFAULT_SAMPLE_STEPS
from sb3_combrel.transfer.methods.master import DEFAULT_RANDOM_STEPS
from sb3_combrel.transfer.prior.prior_sets import PRACTICAL_SETS

#: Instances of a pair's source, or a list of those of several.
Sources = SourceInstances | list[SourceInstances]
Make = Callable[[Sources, Pair], Transfer | None]

#: What all others are compared with.
NONE = "none"
#: Steps after which what most methods need is compiled, or loaded from the cache.
COMPILED_STEPS = 60


class DoesNotFit(ValueError):
    """A method cannot be used with a pair; the message says why. Its cell in the tables stays empty."""


@dataclass(frozen=True)
class Method:
    """A method of transfer.

    :param name: on the command line, in tables and in files
    :param description: in the report, with its paper
    :param make: makes the transfer method, not bound, of a pair's source or sources and the pair; None: no transfer. May raise
        :class:`DoesNotFit`
    :param finds_mapping: whether it finds a mapping by itself, so that it takes target steps until it has one
    :param compiled_steps: steps of a run after which all that it needs is compiled and imported
    :param same_as: of a pair: name of another method that makes the same there, or None; it is then run once
    :param digest: of the file in which a third party defines it; "" for the package's own
    :raises ValueError: if the name has other characters than letters, digits, "-", "_" and "."
    """

    name: str
    description: str
    make: Make
    finds_mapping: bool = False
    compiled_steps: int = COMPILED_STEPS
    same_as: Callable[[Pair], str | None] | None = None
    digest: str = ""

    def __post_init__(self) -> None:
        check_name(self.name)


def run_as(method: Method, methods: Sequence[Method], pair: Pair) -> str:
    """Name of the method whose runs are those of one in a pair: its own where the one that makes the same is not chosen."""
    other = None if method.same_as is None else method.same_as(pair)
    return other if other is not None and any(each.name == other for each in methods) else method.name


def the_one(sources: Sources, name: str) -> SourceInstances:
    """Return the instances of the only source, for the method of a name; raises DoesNotFit if there are several."""
    if isinstance(sources, SourceInstances):
        return sources
    raise DoesNotFit(f"{name} takes one source, and the pair has {len(sources)}")


def _oracle(sources: Sources, pair: Pair) -> Transfer:
    if pair.known is None:
        raise DoesNotFit("nobody knows the mapping")
    if isinstance(pair.known, Sequence) and all(isinstance(each, FactoredMapping) for each in pair.known):
        return KnownCopies(sources, pair.known)  # type: ignore[arg-type]
    return TIMBREL(the_one(sources, "the oracle"), pair.known, use="prior")  # type: ignore[arg-type]


def _timbrel(sources: Sources, pair: Pair) -> Transfer:
    if pair.known_by_action is None:
        raise DoesNotFit("TIMBREL needs a mapping by hand, and nobody knows one")
    return TIMBREL(the_one(sources, "TIMBREL"), pair.known_by_action)


def _learned(method: Callable[[SourceInstances], Transfer]) -> Make:
    """Make a method that learns its mapping from samples of one source and of the target."""
    return lambda sources, pair: method(the_one(sources, method.__name__))


def _soft_homomorphism(sources: Sources, pair: Pair) -> Transfer:
    return SoftHomomorphism(the_one(sources, "SoftHomomorphism"), mirrored=pair.mappings.startswith("signed_"))


def _same_as_factored(pair: Pair) -> str | None:
    """COMBREL by default is COMBREL with the pair's factored mappings if it has mirrored ones, for which the default looks."""
    return FACTORED if pair.mappings == PRACTICAL_SETS[0] else None


FACTORED = "COMBREL-factored"
_FACHANTIDIS = 'Fachantidis, Partalas, Taylor & Vlahavas, "Transfer learning with probabilistic mapping selection", 2015'
_MASTER = 'Taylor, Kuhlmann & Stone, "Autonomous transfer for reinforcement learning", AAMAS 2008'
_TALVITIE = 'Talvitie & Singh, "An experts algorithm for transfer learning", IJCAI 2007'
_LAZARIC = 'Lazaric, Restelli & Bonarini, "Transfer of samples in batch reinforcement learning", ICML 2008'
_SORG = 'Sorg & Singh, "Transfer via soft homomorphisms", AAMAS 2009'
_CODING = 'Ammar, Tuyls, Taylor, Driessens & Weiss, "Reinforcement learning transfer via sparse coding", AAMAS 2012'
_RBM = (
    'Ammar, Mocanu, Taylor, Driessens, Tuyls & Weiss, "Automatically mapped transfer between reinforcement learning tasks via '
    'three-way restricted Boltzmann machines", ECML 2013'
)
_TAYLOR = 'Taylor, Jong & Stone, "Transferring instances for model-based reinforcement learning", ECML 2008'

# Takes target steps until it has found a mapping.
_finding = partial(Method, finds_mapping=True)

#: In the order of tables. Another method of this package is another line.
_METHODS: Sequence[Method] = (
    Method(NONE, "No transfer: Fitted R-Max alone.", lambda sources, pair: None),
    Method(
        "random-by-state",
        "Control: instances through a mapping that is drawn anew for each state, from the set that COMBREL-instances has.",
        lambda sources, pair: TIMBREL(sources, "random", mappings=pair.instance_mappings),
    ),
    Method(
        "random-by-run",
        "Control: the source as a prior through a factored mapping that is drawn once for the run.",
        lambda sources, pair: TIMBREL(sources, "random", mappings=pair.mappings, use="prior"),
    ),
    Method("oracle", "Control: the source as a prior through the known mapping.", _oracle),
    Method("TIMBREL", f"Instances through the known mapping, by hand ({_TAYLOR}).", _timbrel),
    _finding(
        "COMBREL-paper",
        f"Instances through the mapping that complies best with the first episode ({_FACHANTIDIS}).",
        lambda sources, pair: COMBREL.paper(sources, pair.instance_mappings),
    ),
    _finding(
        "COMBREL-instances",
        "COMBREL with instances as this package has it: compliance online, with the guards of its defaults.",
        lambda sources, pair: COMBREL(sources, pair.instance_mappings, use="instances"),
    ),
    _finding(
        "COMBREL",
        "COMBREL by default: factored mappings as a prior, mirrored ones too.",
        lambda sources, pair: COMBREL(sources),
        same_as=_same_as_factored,
    ),
    _finding(
        FACTORED,
        "COMBREL that is told whether variables are mirrored: factored mappings as a prior, mirrored ones or none.",
        lambda sources, pair: COMBREL(sources, pair.mappings, use="prior"),
    ),
    _finding(
        "MASTER",
        f"The one mapping that predicts 100 random transitions best, as a prior ({_MASTER}).",
        lambda sources, pair: MASTER(sources, pair.instance_mappings),
        compiled_steps=DEFAULT_RANDOM_STEPS + COMPILED_STEPS,
    ),
    _finding(
        "experts",
        f"The source's policy seen through mappings, ten at most, and the agent: a bandit chooses who acts ({_TALVITIE}).",
        lambda sources, pair: MappingExperts(sources, pair.instance_mappings),
    ),
    _finding(
        "sample-transfer",
        f"1000 instances of all sources through all mappings, drawn by the compliance of tasks and by relevance ({_LAZARIC}).",
        lambda sources, pair: SampleTransfer(sources, pair.instance_mappings),
        compiled_steps=2 * COMPILED_STEPS,
    ),
    _finding(
        "sample-transfer-near",
        "The same with a relevance that does not favour instances far from the target's transitions.",
        lambda sources, pair: SampleTransfer(sources, pair.instance_mappings, relevance="near"),
        compiled_steps=2 * COMPILED_STEPS,
    ),
    _finding(
        "soft-homomorphism",
        f"The source as a prior through a mixture of mappings that is fitted to the target ({_SORG}).",
        _soft_homomorphism,
    ),
    _finding(
        "sparse-coding",
        f"All source data through a mapping by sparse coding of 200 random transitions ({_CODING}).",
        _learned(SparseCodingMapping),
        compiled_steps=DEFAULT_SAMPLE_STEPS + COMPILED_STEPS,
    ),
    _finding(
        "three-way-RBM",
        f"All source data through a three-way restricted Boltzmann machine of 200 random transitions ({_RBM}).",
        _learned(ThreeWayRBM),
        compiled_steps=DEFAULT_SAMPLE_STEPS + COMPILED_STEPS,
    ),
)
METHODS: dict[str, Method] = {method.name: method for method in _METHODS}

_HOW_TO_NAME = 'a method of your own is "package.module:Name" or "path/to/file.py:Name"'


def method_of(text: str) -> Method:
    """Return the method of a name, or one that a third party defines.

    :param text: one of :data:`METHODS`; or "package.module:Name" or "path/to/file.py:Name", where Name is a :class:`Method`, a
        transfer class that is called with the source, or a function of the source and the pair that returns a transfer object
    """
    if text in METHODS:
        return METHODS[text]
    if ":" not in text:
        raise ValueError(f"methods must be of {', '.join(METHODS)}, or all; {_HOW_TO_NAME}; got {text!r}")
    found, digest = load_attribute("methods", text)
    name = found.name if isinstance(found, Method) else text.rpartition(":")[2]
    if name in METHODS:
        raise ValueError(f"methods: {text} must have a name that no method of the package has, got {name}")
    if isinstance(found, Method):
        return replace(found, digest=digest)
    if inspect.isabstract(found):
        raise ValueError(f"methods: {text} lacks {', '.join(sorted(found.__abstractmethods__))}, which a transfer method has")
    # A class without a docstring would inherit its parent's.
    description = inspect.cleandoc(getattr(found, "__doc__", None) or "").partition("\n")[0]
    if isinstance(found, type) and issubclass(found, Transfer):
        make: Any = found
        return _finding(name, description, lambda sources, pair: make(sources), digest=digest)
    if callable(found) and not isinstance(found, type):
        return _finding(name, description, found, digest=digest)
    raise ValueError(f"methods: {text} must be a Method, a subclass of Transfer or a function, got {found!r}")
