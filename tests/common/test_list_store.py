"""The store of many short lists against a dict of lists."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from sb3_combrel.common.list_store import ListStore, reserve

N_LISTS = 7


@njit
def append(store, p, item, weight):
    """Append an entry to list ``p``; False if the store must grow first."""
    length = np.int64(store.length[p])
    if not reserve(store, p, length + 1):
        return False
    store.item[store.start[p] + length] = item
    store.weight[store.start[p] + length] = weight
    store.length[p] = length + 1
    return True


@njit
def make_room(store, p, n_entries):
    return reserve(store, p, n_entries)


def growing(store, function, *arguments):
    """Call a function of the store until there is room; the store, which may be a larger one."""
    while not function(store, *arguments):
        larger = store.with_room()
        assert len(larger.item) == len(larger.weight) == 2 * len(store.item)
        store = larger
    return store


def assert_same_lists(store, expected):
    for p in range(N_LISTS):
        items, weights = store.entries(p)
        assert list(zip(items.tolist(), weights.tolist(), strict=True)) == expected[p]


def assert_slots_are_apart(store):
    used = np.flatnonzero(store.start >= 0)
    used = used[np.argsort(store.start[used])]
    ends = store.start[used] + (4 << store.size_class[used].astype(np.int64))
    assert (ends <= np.append(store.start[used], len(store.item))[1:]).all()


operations = st.lists(
    st.one_of(
        st.tuples(st.just("append"), st.integers(0, N_LISTS - 1), st.integers(0, 2**31 - 1)),
        st.tuples(st.just("append many"), st.integers(0, N_LISTS - 1), st.integers(1, 70)),
        st.tuples(st.just("reserve"), st.integers(0, N_LISTS - 1), st.integers(1, 100)),
        st.tuples(st.just("cut"), st.integers(0, N_LISTS - 1), st.integers(0, 8)),
    ),
    max_size=60,
)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(operations, st.sampled_from([4, 16, 1024]))
def test_a_list_store_has_the_lists_of_a_dict_of_lists(steps, capacity):
    store, expected = ListStore.empty(N_LISTS, capacity), {p: [] for p in range(N_LISTS)}
    for number, (operation, p, argument) in enumerate(steps):
        if operation == "append":
            store = growing(store, append, p, argument, float(number))
            expected[p].append((argument, float(number)))
        elif operation == "append many":
            for item in range(argument):
                store = growing(store, append, p, item, number + item / 128)
                expected[p].append((item, number + item / 128))
        elif operation == "reserve":
            store = growing(store, make_room, p, argument)
        else:
            store.length[p] = min(argument, len(expected[p]))
            del expected[p][argument:]
        assert_same_lists(store, expected)
    assert_slots_are_apart(store)


def test_slots_that_longer_lists_have_left_are_used_again():
    n = 10
    store = ListStore.empty(2 * n, 256)
    for p in range(n):
        assert make_room(store, p, 4)
    left = store.start[:n].copy()
    for p in range(n):
        assert make_room(store, p, 5)
    for p in range(n, 2 * n):
        assert make_room(store, p, 3)
    assert sorted(store.start[n:]) == sorted(left)
