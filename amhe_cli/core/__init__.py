"""Values that everybody uses; numpy only."""
