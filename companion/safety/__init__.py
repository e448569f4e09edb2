"""The guard over everything else: inputs that age, estimates that worsen, a fence, a battery."""
