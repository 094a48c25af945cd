"""`cosim bench people`: how the crowd walks, beside what was measured of people."""
