"""Everything that touches an arm or a camera: plants, safety filter, controller, hw server. No torch, no UI."""
