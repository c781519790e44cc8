"""What `benchmarks.tiltone_study` is made of: `runs` of the robot, the delays of real links, tables and figures."""
