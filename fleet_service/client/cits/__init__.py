"""Door to cooperative ITS: alerts leave as ETSI DENM over AMQP 1.0, and foreign DENM come in as a
witness.

Messages are not signed here. Signing (ETSI TS 103 097) and its certificates belong to the gateway
of the operator, between this and the interchange.
"""
