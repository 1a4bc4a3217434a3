"""The rollout-matching cost: windows, their first states, residuals, costs."""
