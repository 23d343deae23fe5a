"""Workers: run the stages of jobs durably, each in a process of its own."""
