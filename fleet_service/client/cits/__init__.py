"""Gateway to cooperative ITS (C-ITS). Alerts are sent as ETSI DENM (hazard messages) over AMQP 1.0;
DENM from other stations are used as reports of one additional vehicle.

Messages are not signed here. The operator's own gateway, between this program and the AMQP server,
must sign them (ETSI TS 103 097).
"""
