"""Result files as tables, pictures and a web page; no JAX, no MuJoCo."""
