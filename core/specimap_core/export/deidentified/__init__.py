"""De-identified exports: nothing that a client wrote, nothing that a device wrote about itself, no ids and no dates.

Everything is written anew from pixels and numbers. What is kept is listed; whatever is not listed stays out.
``plan`` is light, for who makes the plan; ``archive`` needs the libraries of photos and cubes.
"""
