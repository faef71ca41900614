"""The map bundle: its format, reader, writer, search index, streets and calibration.

Entry: ``reader.MapBundle.open`` and ``writer.write_bundle``.
"""
