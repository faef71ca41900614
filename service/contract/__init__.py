"""The fields of requests and answers, shared by REST, gRPC and the clients.

Entry: ``schema`` for the fields, ``convert.query_from`` and ``convert.answer_from`` to and from the core.
"""
