-- The first schema: maps, references, and the three parts of a descriptor each in a table of its own, so that
-- a scan of one part never reads the pages of another.
--
-- Every `checksum` is a CRC-32 over the row's other columns (see src/store/sqlite/rows.rs for the exact bytes).

CREATE TABLE map (
    number          INTEGER PRIMARY KEY,
    name            TEXT,                -- NULL once deleted: invisible from that commit on, purged afterwards
    model           TEXT    NOT NULL,    -- the only model whose descriptors the map holds
    version         INTEGER NOT NULL,    -- which rows of global_vector are the map's
    pending_version INTEGER,             -- rows being computed for another head
    reference_count INTEGER NOT NULL,    -- kept by the writer in the transaction of each change
    calibration     TEXT,                -- JSON
    created_at      INTEGER NOT NULL,    -- microseconds since 1970, UTC
    checksum        INTEGER NOT NULL     -- over all but reference_count, pending_version
) STRICT;

CREATE UNIQUE INDEX map_by_name ON map (name) WHERE name IS NOT NULL;

CREATE TABLE reference (
    number       INTEGER PRIMARY KEY,    -- from sequence, never used twice
    id           BLOB    NOT NULL,       -- UUID version 7, 16 bytes
    map          INTEGER NOT NULL REFERENCES map (number),
    external_id  TEXT,
    lat          REAL,
    lon          REAL,
    heading      REAL,
    captured_at  INTEGER,                -- microseconds since 1970, UTC
    metadata     TEXT,                   -- JSON object
    content_hash BLOB    NOT NULL,       -- SHA-256 of the image bytes
    created_at   INTEGER NOT NULL,       -- microseconds since 1970, UTC
    checksum     INTEGER NOT NULL
) STRICT;

CREATE UNIQUE INDEX reference_by_id ON reference (id);
CREATE UNIQUE INDEX reference_by_map ON reference (map, id);
CREATE INDEX reference_by_map_number ON reference (map);
CREATE UNIQUE INDEX reference_by_external_id ON reference (map, external_id) WHERE external_id IS NOT NULL;

-- Clustered by version: the vectors of one map lie side by side, and a head can be exchanged by writing a second
-- version beside the first and then changing one number.
CREATE TABLE global_vector (
    version  INTEGER NOT NULL,
    number   INTEGER NOT NULL,           -- reference.number
    vector   BLOB    NOT NULL,           -- f32 little-endian
    checksum INTEGER NOT NULL,
    PRIMARY KEY (version, number)
) STRICT, WITHOUT ROWID;

CREATE TABLE pooled_vector (
    number   INTEGER PRIMARY KEY REFERENCES reference (number),
    vector   BLOB    NOT NULL,           -- f16 little-endian
    checksum INTEGER NOT NULL
) STRICT;

CREATE TABLE patches (
    number   INTEGER PRIMARY KEY REFERENCES reference (number),
    checksum INTEGER NOT NULL,           -- binds the number to the checksum that the blob itself carries
    blob     BLOB    NOT NULL            -- see src/store/codec.rs
) STRICT;

-- References found damaged. They stay where they are, are served no more, and can be deleted or sent again.
CREATE TABLE quarantine (
    number      INTEGER PRIMARY KEY,     -- reference.number
    id          BLOB    NOT NULL,
    map         INTEGER NOT NULL,
    reason      TEXT    NOT NULL,
    detected_at INTEGER NOT NULL
) STRICT;

-- Versions of global_vector that no map uses any more; removed in the background.
CREATE TABLE retired_version (
    version INTEGER PRIMARY KEY
) STRICT;

-- The next map.version and reference.number.
CREATE TABLE sequence (
    name TEXT PRIMARY KEY,
    next INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

INSERT INTO sequence (name, next) VALUES ('version', 1), ('reference', 1);
