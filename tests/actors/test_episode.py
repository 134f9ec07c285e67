"""What an episode's message says of its object."""

from congrasp.actors.episode import _geometry
from congrasp.common.objects import procedural


def test_sizes_are_real_numbers_for_objects_of_meshes_too():
    bowl = procedural.generate(3, "bowl")
    assert {piece.kind for piece in bowl.pieces} == {"mesh"}
    assert _geometry(bowl)["piece_size"].dtype == float
