"""A bounded queue that its clients share fairly.

A client is an account: a certificate, or an address where there are no certificates. Its peers are
its connections. Accounts take turns, and within an account its peers do, so that another name or
another connection gains a client nothing.
"""

import collections
import itertools
from collections.abc import Iterator, Mapping
from typing import Generic, NamedTuple, TypeVar

from congrasp.common.transport.senders import Peer

T = TypeVar("T")


class _Entry(NamedTuple, Generic[T]):
    """A queued item and its number in the order of arrival."""

    number: int
    item: T


_Entries = collections.deque[_Entry[T]]


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
        self._accounts: collections.OrderedDict[str, collections.OrderedDict[str, _Entries[T]]] = (
            collections.OrderedDict()
        )
        self._numbers = itertools.count()

    def __len__(self) -> int:
        """Number of items."""
        return sum(self.length_of_account(account) for account in self._accounts)

    def __iter__(self) -> Iterator[T]:
        """Yields all items, those of one peer together."""
        for peers in self._accounts.values():
            for entries in peers.values():
                for entry in entries:
                    yield entry.item

    @property
    def peers(self) -> int:
        """Number of peers with an item."""
        return sum(len(peers) for peers in self._accounts.values())

    @property
    def accounts(self) -> int:
        """Number of accounts with an item."""
        return len(self._accounts)

    def peers_of(self, account: str) -> int:
        """Number of peers of an account with an item."""
        return len(self._peers(account))

    def length_of_account(self, account: str) -> int:
        """Number of items of an account."""
        return sum(len(entries) for entries in self._peers(account).values())

    def length_of_peer(self, peer: Peer) -> int:
        """Number of items of a peer."""
        return len(self._peers(peer.account).get(peer.name, ()))

    def is_at_share(self, peer: Peer) -> bool:
        """True if a peer has as many items as one peer may have."""
        return self.length_of_peer(peer) >= self._share

    def has_room(self, peer: Peer) -> bool:
        """True if `add` would queue an item of this peer, possibly in place of another item."""
        if self.is_at_share(peer):
            return False
        if len(self) < self._depth or not self.length_of_account(peer.account):
            return True
        return self._loser(peer) != peer

    def add(self, item: T, peer: Peer) -> T | None:
        """Queues an item for which there is room.

        Returns:
          The item that lost its place, if any.
        """
        evicted = None
        if len(self) >= self._depth:
            loser = self._loser(peer)
            if loser != peer and self.length_of_account(loser.account) > 1:
                evicted = self._pop_newest(loser)
        peers = self._accounts.setdefault(peer.account, collections.OrderedDict())
        entries = peers.setdefault(peer.name, collections.deque())
        entries.append(_Entry(next(self._numbers), item))
        return evicted

    def in_turn(self) -> Iterator[Peer]:
        """Yields the peers in the order of their turns: one of each account, then again."""
        rounds = [self._in_account(account) for account in self._accounts]
        for turn in itertools.zip_longest(*rounds):
            for peer in turn:
                if peer is not None:
                    yield peer

    def _in_account(self, account: str) -> list[Peer]:
        """Peers of an account in the order of their turns."""
        return [Peer(account, name) for name in self._peers(account)]

    def first(self, peer: Peer) -> T:
        """Oldest item of a peer."""
        return self._accounts[peer.account][peer.name][0].item

    def end_turn(self, peer: Peer) -> None:
        """Puts a peer behind the others of its account, and its account behind the others."""
        self._accounts[peer.account].move_to_end(peer.name)
        self._accounts.move_to_end(peer.account)

    def pop(self, peer: Peer) -> T:
        """Removes and returns the oldest item of a peer."""
        item = self._accounts[peer.account][peer.name].popleft().item
        self._drop_empty(peer)
        return item

    def discard(self, item: T) -> None:
        """Removes an item if it is queued."""
        for account, peers in self._accounts.items():
            for name, entries in peers.items():
                for entry in entries:
                    if entry.item is item:
                        entries.remove(entry)
                        self._drop_empty(Peer(account, name))
                        return

    def _peers(self, account: str) -> Mapping[str, _Entries[T]]:
        """Items of an account, by peer."""
        return self._accounts.get(account, collections.OrderedDict())

    def _loser(self, newcomer: Peer) -> Peer:
        """Peer that would lose its newest item if the newcomer's were queued.

        Of equally long ones it is the newcomer, else the one whose newest item arrived last.
        """

        def rank_of_account(account: str) -> tuple[int, bool, int]:
            grown = self.length_of_account(account) + (account == newcomer.account)
            return grown, account == newcomer.account, self._newest(account)

        account = max({*self._accounts, newcomer.account}, key=rank_of_account)
        peers = self._peers(account)
        names = {*peers}
        if account == newcomer.account:
            names.add(newcomer.name)

        def rank_of_peer(name: str) -> tuple[int, bool, int]:
            peer = Peer(account, name)
            entries = peers.get(name)
            newest = entries[-1].number if entries else -1
            return self.length_of_peer(peer) + (peer == newcomer), peer == newcomer, newest

        return Peer(account, max(names, key=rank_of_peer))

    def _newest(self, account: str) -> int:
        """Number of the newest item of an account; -1 without one."""
        peers = self._peers(account)
        return max((entries[-1].number for entries in peers.values()), default=-1)

    def _pop_newest(self, peer: Peer) -> T:
        item = self._accounts[peer.account][peer.name].pop().item
        self._drop_empty(peer)
        return item

    def _drop_empty(self, peer: Peer) -> None:
        peers = self._accounts[peer.account]
        if not peers[peer.name]:
            del peers[peer.name]
        if not peers:
            del self._accounts[peer.account]
