-- Heads that maps keep for themselves. A map without a row here is searched with the server's own head.

CREATE TABLE map_head (
    version  INTEGER PRIMARY KEY,        -- the rows of global_vector that this head made: map.version
    file     BLOB    NOT NULL,           -- the head's safetensors
    checksum INTEGER NOT NULL            -- over both and the model the map is bound to
) STRICT;
