"""What the operator sees: view models, the viser page, rerun views. Reads telemetry, sends intents only."""
