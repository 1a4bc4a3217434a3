"""What offline and online estimation and the design of experiments share: linearise, eliminate, step."""
