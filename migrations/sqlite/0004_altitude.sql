-- How high a reference was taken, in metres. Part of the row's checksum where it has a value, so that rows from before
-- keep theirs.

ALTER TABLE reference ADD COLUMN alt REAL;
