"""Conversion of recordings between formats: `r2p bag convert`.

`formats` has the table of formats, and `convert`, which reads one and writes the other as a stream of `stream`. Each
format is a module with two functions, `read` and `open_sink`, and is imported when a file of it is converted:

    mcap_files  our own recordings, and MCAP files of others
    rosbag1     ROS 1
    rosbag2     ROS 2: a directory with metadata.yaml, or a database of SQLite
    candump     logs of CAN frames, as text
    can_files   CAN frames in BLF and ASC, by python-can
    csv_tables  CSV, a table for each topic
    parquet     Parquet, a table for each topic, in the types of Apache Arrow

`retyping` gives topics types, and makes ROS's standard types of r2p's.
"""
