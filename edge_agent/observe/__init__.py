"""Conversion of estimates along a drive to observations, one per visited cell. The
package is pure.
"""
