"""Which motion makes the parameters visible: excitations, their information, and the best of them."""
