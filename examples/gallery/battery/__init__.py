"""How full is a lithium-ion cell, from its voltage and current while a car is driven?"""
