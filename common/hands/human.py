"""The human right hand: 20 anatomical finger joints, four for each finger.

Wrist frame: origin at the lunate, fingers towards -y, thumb side +x, back of the hand +z. Fingers flex with positive
angles, the thumb's `mp` and `ip` with negative ones.
"""

from congrasp.common.hands.files import shipped_hand

HUMAN = shipped_hand("human")
