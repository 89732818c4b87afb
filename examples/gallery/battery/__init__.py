"""How full a lithium-ion cell is, from its voltage and current while a car is driven."""
