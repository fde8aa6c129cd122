def access(report, program):
    pass
