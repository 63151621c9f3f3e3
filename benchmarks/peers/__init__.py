"""Other simulators on the same machine in the same run; each module is imported only in a process of its own."""
