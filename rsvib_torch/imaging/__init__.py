"""How a scene becomes a frame: motion within an exposure, point spread functions, blur, simulation."""
