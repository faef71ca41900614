"""The running service without a protocol: settings, maps and their versions, admission, memory, metrics, keys.

Entry: ``engine.Engine.open`` and ``engine.Engine.localize``.
"""
