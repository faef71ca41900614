from hypothesis import settings

# The same examples on every machine, and no clock: a busy one is no defect of the code.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")
