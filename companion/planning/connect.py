"""RRT-Connect (Kuffner and LaValle 2000): two trees that grow towards each other; a first path, fast."""

from __future__ import annotations

from numba import njit

from companion.planning.grid import segment_free
from companion.planning.tree import add, gap, nearest, nearest_of, way_to

DRAWS = 3  # uniforms per iteration
_FEW = 300  # nodes that are looked at one by one


@njit(cache=True, nogil=True)
def connect(steps, nodes, links, heads, counts, box, draws, step, bucket, out):  # type: ignore[no-untyped-def]
    """Grow both trees, one iteration per row of `draws`; once joined, write the path to `out`.

    nodes (2, C, 4), links (2, C, 4), heads (2, I, J, K), counts (2,): tree 0 is rooted at the
    start, tree 1 at the goal; samples come from `box` (2, 3).
    Returns the number of points of the path; 0: not joined yet.
    """
    for row in range(draws.shape[0]):
        a = 0 if counts[0] <= counts[1] else 1
        b = 1 - a
        if max(counts[0], counts[1]) >= nodes.shape[1] - 1:
            return 0
        for k in range(3):
            nodes[a, counts[a], k] = box[0, k] + draws[row, k] * (box[1, k] - box[0, k])
        if not _extend(steps, nodes[a], links[a], heads[a], counts, a, step, bucket):
            continue
        new = counts[a] - 1
        while counts[b] < nodes.shape[1]:
            for k in range(3):
                nodes[b, counts[b], k] = nodes[a, new, k]
            if not _extend(steps, nodes[b], links[b], heads[b], counts, b, step, bucket):
                break
            if gap(nodes[b], counts[b] - 1, nodes[a], new) < 1e-9:
                return _join(nodes, links, counts, out)
    return 0


@njit(cache=True, nogil=True)
def _extend(steps, nodes, links, head, counts, which, step, bucket):  # type: ignore[no-untyped-def]
    """Move the new node's position to within a step of its nearest node; add it if the edge is free."""
    new = counts[which]
    x = nodes[new : new + 1]
    from_ = nearest_of(nodes, new, x) if new < _FEW else nearest(nodes, links, head, x, bucket)
    far = gap(nodes, from_, nodes, new)
    if far > step:
        for k in range(3):
            nodes[new, k] = nodes[from_, k] + (nodes[new, k] - nodes[from_, k]) * step / far
    if not segment_free(steps, nodes[from_], nodes[new]):
        return False
    add(nodes, links, head, new, from_, bucket)
    counts[which] = new + 1
    return True


@njit(cache=True, nogil=True)
def _join(nodes, links, counts, out):  # type: ignore[no-untyped-def]
    """start .. newest of tree 0, then newest of tree 1 (the same place) .. goal."""
    first = way_to(nodes[0], links[0], counts[0] - 1, out)
    second = way_to(nodes[1], links[1], counts[1] - 1, out[first:])
    if first == 0 or second == 0:
        return 0
    for n in range((second + 1) // 2):  # reverse the second part
        p, q = first + n, first + second - 1 - n
        for k in range(3):
            out[p, k], out[q, k] = out[q, k], out[p, k]
    return first + second
