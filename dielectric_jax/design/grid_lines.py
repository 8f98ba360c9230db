"""Changes of a value on a grid, and the lines that they join into; knows no membrane."""

import numpy as np

__all__ = ["beside_change", "chains", "changes"]


def beside_change(whole: np.ndarray, reach: int) -> np.ndarray:
    """Designs within `reach` of a change of the regime, along both axes."""
    change = np.zeros(whole.shape, bool)
    across = whole[:, 1:] != whole[:, :-1]
    along = whole[1:] != whole[:-1]
    change[:, 1:] |= across
    change[:, :-1] |= across
    change[1:] |= along
    change[:-1] |= along
    for axis in (0, 1):
        total = np.cumsum(np.pad(change, [(reach + 1, reach) if k == axis else (0, 0) for k in (0, 1)]), axis=axis)
        width = 2 * reach + 1
        lead, lag = (np.take(total, np.arange(start, start + whole.shape[axis]), axis=axis) for start in (width, 0))
        change = lead > lag
    return change


def changes(whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ends (row, column) of all edges of the grid between two regimes: first those along rows."""
    i, j = np.nonzero(whole[:, 1:] != whole[:, :-1])
    k, m = np.nonzero(whole[1:] != whole[:-1])
    one = np.stack([np.concatenate([i, k]), np.concatenate([j, m])], axis=1)
    other = np.stack([np.concatenate([i, k + 1]), np.concatenate([j + 1, m])], axis=1)
    return one, other


def chains(links: list) -> list[list[int]]:
    """Links between points joined into chains; a chain ends where one or more than two meet."""
    beside: dict = {}
    for a, b in links:
        beside.setdefault(a, set()).add(b)
        beside.setdefault(b, set()).add(a)
    left = {frozenset(pair) for pair in links if pair[0] != pair[1]}
    chains = []
    ends = [k for k, near in beside.items() if len(near) != 2]
    for begin in [*ends, *beside]:
        for following in sorted(beside[begin]):
            if frozenset((begin, following)) not in left:
                continue
            chain = [begin, following]
            left.discard(frozenset(chain))
            while len(beside[chain[-1]]) == 2:
                onward = [k for k in beside[chain[-1]] if frozenset((chain[-1], k)) in left]
                if not onward:
                    break
                left.discard(frozenset((chain[-1], onward[0])))
                chain.append(onward[0])
            chains.append(chain)
    return chains
