from .camera import Camera as Camera
from .vibration import Vibration as Vibration
