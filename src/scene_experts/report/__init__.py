"""RUN/report.html: everything about a run, or about several beside each other, in one file that needs nothing else."""
