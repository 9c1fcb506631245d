"""The receiver's stages in the order of the signal's flow: regions, chips, payload, receiver.

The stages do not know one another; `receiver.py` joins them.
"""
