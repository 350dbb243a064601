from .camera import Camera as Camera
from .recorded import read_acceleration as read_acceleration
from .vibration import Vibration as Vibration
