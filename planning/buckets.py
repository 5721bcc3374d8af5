"""Nodes that wait for their turn, in buckets by cost: doubly linked lists in three arrays.

With buckets no wider than the shortest edge everything in the lowest one is final, so a search is linear
in the number of its edges; with wider ones a node is taken again when a cheaper way to it is found.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Which bucket a node waits in, where it waits in none.
_NONE = -1


@njit(cache=True)
def make_buckets(n_nodes, n_buckets):  # type: ignore[no-untyped-def]
    """Return (bucket_of, head, after, before) of an empty queue."""
    return (
        np.full(n_nodes, _NONE, np.int32),
        np.full(n_buckets, _NONE, np.int32),
        np.empty(n_nodes, np.int32),
        np.empty(n_nodes, np.int32),
    )


@njit(cache=True)
def remove(queue, node):  # type: ignore[no-untyped-def]
    """Take a node out of the bucket that it waits in."""
    bucket_of, head, after, before = queue
    p, q = before[node], after[node]
    if p >= 0:
        after[p] = q
    else:
        head[bucket_of[node]] = q
    if q >= 0:
        before[q] = p
    bucket_of[node] = _NONE


@njit(cache=True)
def put(queue, node, bucket):  # type: ignore[no-untyped-def]
    """Let a node wait in a bucket, moved there if it waits elsewhere; return how many more wait now."""
    bucket_of, head, after, before = queue
    more = 1
    if bucket_of[node] == bucket:
        return 0
    if bucket_of[node] >= 0:
        remove(queue, node)
        more = 0
    bucket_of[node] = bucket
    old = head[bucket]
    after[node], before[node] = old, _NONE
    if old >= 0:
        before[old] = node
    head[bucket] = node
    return more
