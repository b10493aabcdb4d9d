"""What learns and infers: the only folder of the application that imports torch, with far_app/methods."""
