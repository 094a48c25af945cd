import cosim as cosim  # before numpy is loaded: see cosim/rounding.py
