"""A bounded queue that its clients share fairly.

A client is an account: a certificate, or an address where there are no certificates. Its peers are
its connections. Accounts take turns, and within an account its peers do, so that another name or
another connection gains a client nothing.

A client that waits for each answer has nothing queued when it sends the next query. Its turn comes
before those of clients with a backlog (`_Turns`), so that its latency does not grow with theirs.
"""

import collections
import itertools
from collections.abc import Callable, Iterator
from typing import Generic, NamedTuple, TypeVar

from congrasp.common.transport.senders import Peer

T = TypeVar("T")
_LONG_ROTATION = 256
"""Length above which a rotation drops names without an item: peers invent names for free."""


class _Entry(NamedTuple, Generic[T]):
    """A queued item and its number in the order of arrival."""

    number: int
    item: T


class _Turns:
    """Order in which names take turns: newcomers first, then the others in rotation (the scheduler
    of RFC 8290).

    A name is a newcomer until its first turn ends, and then joins the rotation. There it stays
    until its turn comes and it has no item: a name that returns earlier is not a newcomer again, so
    that a name whose items arrive faster than its turns come never precedes the others. A rotation
    longer than `_LONG_ROTATION` drops such names earlier.
    """

    def __init__(self) -> None:
        self._newcomers: collections.OrderedDict[str, None] = collections.OrderedDict()
        self._rotation: collections.OrderedDict[str, None] = collections.OrderedDict()

    def __iter__(self) -> Iterator[str]:
        """Yields the names in order, including those without an item."""
        return itertools.chain(self._newcomers, self._rotation)

    def is_newcomer(self, name: str) -> bool:
        """True if a name has not had a turn."""
        return name in self._newcomers

    def enter(self, name: str) -> None:
        """Adds a name that now has an item."""
        if name not in self._rotation:
            self._newcomers[name] = None

    def end(self, name: str, has_items: Callable[[str], bool]) -> None:
        """Ends the turn of a name: it is the last in the rotation from now on.

        Args:
          name: the name.
          has_items: returns True if a name has an item; the names that had their turn without one
            leave the rotation.
        """
        if name in self._newcomers:
            del self._newcomers[name]
        else:
            passed = list(itertools.takewhile(lambda other: other != name, self._rotation))
            for other in passed:
                if not has_items(other):
                    del self._rotation[other]
            self._rotation.pop(name, None)
        self._rotation[name] = None
        self._forget_idle(has_items)

    def _forget_idle(self, has_items: Callable[[str], bool]) -> None:
        """Removes the first name without an item from a rotation that is too long."""
        if len(self._rotation) <= _LONG_ROTATION:
            return
        idle = next((name for name in self._rotation if not has_items(name)), None)
        if idle is not None:
            del self._rotation[idle]

    def leave(self, name: str) -> None:
        """Forgets a newcomer that lost its items without a turn; the rotation is unchanged."""
        self._newcomers.pop(name, None)


class _Account(Generic[T]):
    """Queued items of an account, by the name of its peer."""

    def __init__(self) -> None:
        self.turns = _Turns()
        self.length = 0
        self._entries: dict[str, collections.deque[_Entry[T]]] = {}

    @property
    def names(self) -> list[str]:
        """Names of the peers with an item, in the order of their turns."""
        return [name for name in self.turns if name in self._entries]

    @property
    def peers(self) -> int:
        """Number of peers with an item."""
        return len(self._entries)

    @property
    def newcomers(self) -> int:
        """Number of peers with an item that have not had a turn."""
        return sum(map(self.turns.is_newcomer, self._entries))

    @property
    def peers_with_single_item(self) -> int:
        """Number of peers with exactly one item. Such a peer may be waiting for the answer."""
        return sum(len(entries) == 1 for entries in self._entries.values())

    def items(self) -> Iterator[T]:
        """Yields all items, grouped by peer."""
        for entries in self._entries.values():
            for entry in entries:
                yield entry.item

    def length_of(self, name: str) -> int:
        """Number of items of a peer."""
        return len(self._entries.get(name, ()))

    def newest(self) -> int:
        """Number of the newest item; -1 without one."""
        return max((entries[-1].number for entries in self._entries.values()), default=-1)

    def newest_of(self, name: str) -> int:
        """Number of the newest item of a peer; -1 without one."""
        entries = self._entries.get(name)
        return entries[-1].number if entries else -1

    def append(self, name: str, entry: _Entry[T]) -> None:
        """Queues an item of a peer."""
        self.turns.enter(name)
        self._entries.setdefault(name, collections.deque()).append(entry)
        self.length += 1

    def first(self, name: str) -> T:
        """Oldest item of a peer."""
        return self._entries[name][0].item

    def end_turn(self, name: str) -> None:
        """Puts a peer behind the others."""
        self.turns.end(name, self._entries.__contains__)

    def pop_first(self, name: str) -> T:
        """Removes and returns the oldest item of a peer."""
        item = self._entries[name].popleft().item
        self._note_removal(name)
        return item

    def pop_newest(self, name: str) -> T:
        """Removes and returns the newest item of a peer."""
        item = self._entries[name].pop().item
        self._note_removal(name)
        return item

    def discard(self, item: T) -> bool:
        """Removes an item; returns True if it was queued."""
        for name, entries in self._entries.items():
            for entry in entries:
                if entry.item is item:
                    entries.remove(entry)
                    self._note_removal(name)
                    return True
        return False

    def _note_removal(self, name: str) -> None:
        """Updates length and turns after an item of a peer was removed."""
        self.length -= 1
        if not self._entries[name]:
            del self._entries[name]
            self.turns.leave(name)


class FairQueue(Generic[T]):
    """Items by account and peer.

    If the queue is full, the account with the most items, and in it the peer with the most, loses
    its newest item: the oldest one is the next to be answered, and the flood is what came last.
    Consequences:

    - An account without a queued item is always admitted.
    - A peer without a queued item is admitted as long as a peer of the longest account has two.

    The queue therefore holds at most `depth` items, or one for each account if these are more.

    Args:
      depth: limit of all items.
      share: limit of one peer's items.
    """

    def __init__(self, depth: int, share: int):
        self._depth = depth
        self._share = share
        self._length = 0
        self._numbers = itertools.count()
        self._accounts: dict[str, _Account[T]] = {}
        self._turns = _Turns()

    def __len__(self) -> int:
        """Number of items."""
        return self._length

    def __iter__(self) -> Iterator[T]:
        """Yields all items, grouped by peer."""
        for account in self._accounts.values():
            yield from account.items()

    @property
    def peers(self) -> int:
        """Number of peers with an item."""
        return sum(account.peers for account in self._accounts.values())

    @property
    def accounts(self) -> int:
        """Number of accounts with an item."""
        return len(self._accounts)

    @property
    def peers_ahead(self) -> int:
        """Number of peers whose turn comes before the peers with a backlog.

        These are the peers of accounts that have not had a turn; if there are none, the peers that
        have not had a turn; and if there are none, the peers with a single item.
        """
        of_new_accounts = 0
        newcomers = 0
        with_single_item = 0
        for name, account in self._accounts.items():
            newcomers += account.newcomers
            with_single_item += account.peers_with_single_item
            if self._turns.is_newcomer(name):
                of_new_accounts += account.peers
        return of_new_accounts or newcomers or with_single_item

    def peers_of(self, account: str) -> int:
        """Number of peers of an account with an item."""
        return self._accounts[account].peers if account in self._accounts else 0

    def length_of_account(self, account: str) -> int:
        """Number of items of an account."""
        return self._accounts[account].length if account in self._accounts else 0

    def length_of_peer(self, peer: Peer) -> int:
        """Number of items of a peer."""
        account = self._accounts.get(peer.account)
        return account.length_of(peer.name) if account else 0

    def is_at_share(self, peer: Peer) -> bool:
        """True if a peer has as many items as one peer may have."""
        return self.length_of_peer(peer) >= self._share

    def has_room(self, peer: Peer) -> bool:
        """True if `add` would queue an item of this peer, possibly in place of another item."""
        if self.is_at_share(peer):
            return False
        if self._length < self._depth or not self.length_of_account(peer.account):
            return True
        return self._loser(peer) != peer

    def add(self, item: T, peer: Peer) -> T | None:
        """Queues an item for which there is room.

        Returns:
          The item that lost its place, if any.
        """
        evicted = None
        if self._length >= self._depth:
            loser = self._loser(peer)
            if loser != peer and self.length_of_account(loser.account) > 1:
                evicted = self._accounts[loser.account].pop_newest(loser.name)
                self._note_removal(loser.account)
        self._turns.enter(peer.account)
        account = self._accounts.setdefault(peer.account, _Account())
        account.append(peer.name, _Entry(next(self._numbers), item))
        self._length += 1
        return evicted

    def in_turn(self) -> list[Peer]:
        """Peers in the order of their turns: one of each account, then again."""
        by_account = []
        for name in self._turns:
            if name in self._accounts:
                by_account.append([Peer(name, peer) for peer in self._accounts[name].names])
        order: list[Peer] = []
        for peers in itertools.zip_longest(*by_account):
            order += [peer for peer in peers if peer is not None]
        return order

    def first(self, peer: Peer) -> T:
        """Oldest item of a peer."""
        return self._accounts[peer.account].first(peer.name)

    def end_turn(self, peer: Peer) -> None:
        """Puts a peer behind the other peers of its account, and its account behind all others."""
        self._accounts[peer.account].end_turn(peer.name)
        self._turns.end(peer.account, self._accounts.__contains__)

    def pop(self, peer: Peer) -> T:
        """Removes and returns the oldest item of a peer."""
        item = self._accounts[peer.account].pop_first(peer.name)
        self._note_removal(peer.account)
        return item

    def discard(self, item: T) -> None:
        """Removes an item if it is queued."""
        for name, account in self._accounts.items():
            if account.discard(item):
                self._note_removal(name)
                return

    def _loser(self, newcomer: Peer) -> Peer:
        """Peer that would lose its newest item if the newcomer's were queued.

        Of equally long ones it is the newcomer, else the one whose newest item arrived last.
        """

        def rank_of_account(name: str) -> tuple[int, bool, int]:
            is_own = name == newcomer.account
            newest = self._accounts[name].newest() if name in self._accounts else -1
            return self.length_of_account(name) + is_own, is_own, newest

        longest = max({*self._accounts, newcomer.account}, key=rank_of_account)
        account = self._accounts.get(longest, _Account())
        names = set(account.names)
        if longest == newcomer.account:
            names.add(newcomer.name)

        def rank_of_peer(name: str) -> tuple[int, bool, int]:
            is_own = Peer(longest, name) == newcomer
            return account.length_of(name) + is_own, is_own, account.newest_of(name)

        return Peer(longest, max(names, key=rank_of_peer))

    def _note_removal(self, account: str) -> None:
        """Updates length and turns after an item of an account was removed.

        Of an account without items only its place in the rotation is kept, of an empty queue
        nothing.
        """
        self._length -= 1
        if not self._accounts[account].length:
            del self._accounts[account]
            self._turns.leave(account)
        if not self._length:
            self._turns = _Turns()
