"""Numbers of the elements in a URDF file."""

import math
import xml.etree.ElementTree as ET

from congrasp.services.assets.hands.reading import FaultyFile


def number_of(element: ET.Element, name: str, owner: ET.Element, missing: float = 0.0) -> float:
    """Returns a number of an element.

    Args:
      element: the element.
      name: name of the attribute.
      owner: the joint or link of the element.
      missing: number for an element without the attribute.

    Raises:
      FaultyFile: the attribute is not a finite number.
    """
    text = element.get(name, str(missing))
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        owner_name = f"the {owner.tag} '{owner.get('name', '')[:40]}'"
        raise FaultyFile(
            f"{name} of {owner_name} is '{text[:40]}', not a finite number. Correct it"
        )
    return value
