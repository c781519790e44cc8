"""tiltOne, the balancing robot of thesis 8.3: `nodes` keep it upright and drive it, `robot` is all of it."""
