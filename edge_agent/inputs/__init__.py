"""Input of vehicle signals: live sources and recorded logs, delivered as blocks of samples."""
