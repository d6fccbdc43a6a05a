"""The software of one vehicle: sensors in, friction evidence out."""
