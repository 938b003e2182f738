"""Many missions: fleets, contenders, sensitivity, speed."""
