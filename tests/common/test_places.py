"""Places for connections, shared by addresses."""

from hypothesis import given
from hypothesis import strategies as st

from congrasp.common.transport.places import Places


class Server:
    """Connections by number, as a server would count them."""

    def __init__(self, limit):
        self.places = Places(limit)
        self.open = {}

    def connect(self, number, address):
        """Opens a connection; returns True if it got a place."""
        place = self.places.take(address, lambda: self.open.pop(number))
        if place is None:
            return False
        self.open[number] = (address, place)
        return True

    def disconnect(self, number):
        _, place = self.open.pop(number)
        self.places.leave(place)

    def count(self, address):
        return sum(owner == address for owner, _ in self.open.values())


def test_place_of_a_closed_connection_is_free():
    server = Server(1)
    assert server.connect(0, "a")
    assert not server.connect(1, "a")
    server.disconnect(0)
    assert server.connect(2, "a")


def test_address_with_most_connections_loses_its_newest():
    server = Server(4)
    for number, address in enumerate("abbb"):
        assert server.connect(number, address)
    assert server.connect(4, "c")
    assert sorted(server.open) == [0, 1, 2, 4]
    assert not server.connect(5, "b")


def test_no_connection_is_ended_for_an_equal_one():
    server = Server(3)
    for number, address in enumerate("abc"):
        assert server.connect(number, address)
    assert not server.connect(3, "d")
    assert sorted(server.open) == [0, 1, 2]


@given(st.lists(st.sampled_from("abcdef"), max_size=40), st.integers(1, 8))
def test_places_hold_for_all_orders(addresses, limit):
    server = Server(limit)
    for number, address in enumerate(addresses):
        longest = max(map(server.count, "abcdef"))
        before = server.count(address)
        admitted = server.connect(number, address)
        assert len(server.open) <= limit
        assert admitted == (server.count(address) == before + 1)
        assert admitted or before + 1 >= longest
