"""A robot of 20 modules, as many as the bus of the thesis is made for (3.3.1): one at each joint of six legs."""
