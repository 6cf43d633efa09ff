-- Two more numbers beside those of `sequence`. `commit` counts the groups of writes that were committed, and `store`
-- is drawn at random and stays. The file `commit-mark` repeats both, outside the log: see src/sqlite/mark.rs.

INSERT INTO sequence (name, next) VALUES ('commit', 0), ('store', random());
