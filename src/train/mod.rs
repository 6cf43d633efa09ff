//! Learning the head and the backbone (paper III-F).
