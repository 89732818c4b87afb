"""Which pairs of detectability and observer are worth trying for one horizon more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

__all__ = ["Pairs"]

Pair = tuple[int, int]

# Pairs kept of each kind, from each horizon at which all of them were tried.
_KEPT = 3
# Pairs in whose rates and constants `tighten` searches, with and without a choice before.
_SEARCHED, _SEARCHED_AGAIN = 4, 2


@dataclass
class Pairs:
    """What was best at other horizons.

    Any pair gives a bound that holds; fewer of them make it less tight, hardly so where those
    that were best at a smaller and at a larger horizon are among them.

    Parameters
    ----------
    allowed : dict of str to list of pairs
        The pairs to try, for each kind of bound; all of them, for a kind that is missing.
    """

    allowed: dict[str, list[Pair]] = field(default_factory=dict)
    _levels: dict[str, dict[Pair, float]] = field(default_factory=dict)

    @property
    def searched(self) -> int:
        """In how many pairs the theorem's free choices are searched."""
        return _SEARCHED_AGAIN if self.allowed else _SEARCHED

    def of(self, kind: str, every: Sequence[Pair]) -> Sequence[Pair]:
        """The pairs to try.

        Parameters
        ----------
        kind : str
            Of which kind of bound.
        every : sequence of pairs
            All that there are.
        """
        return self.allowed.get(kind, every)

    def note(self, kind: str, pair: Pair, level: float) -> None:
        """Remember what came of a pair.

        Parameters
        ----------
        kind, pair, level
            Which bound, of which pair, reaches which value.
        """
        self._levels.setdefault(kind, {})[pair] = level

    def best(self, *others: Pairs) -> Pairs:
        """Those that were best here or there, as what to try elsewhere.

        Parameters
        ----------
        *others : Pairs
            What came of the same pairs at other horizons.
        """
        allowed: dict[str, list[Pair]] = {}
        for each in (self, *others):
            for kind, levels in each._levels.items():
                for pair in sorted(levels, key=levels.__getitem__)[:_KEPT]:
                    if pair not in allowed.setdefault(kind, []):
                        allowed[kind].append(pair)
        return Pairs(allowed)
