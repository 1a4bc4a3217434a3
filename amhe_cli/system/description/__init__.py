"""What a `system.yaml`, or the arguments of `System.from_model`, say about a model and its logs."""
