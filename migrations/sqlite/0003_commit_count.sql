-- Three more numbers beside those of `sequence`. `commit` counts the groups of writes that were committed, and `store`
-- is drawn at random and stays. The file `commit-mark` repeats both, outside the log: see
-- crates/store/src/sqlite/mark.rs. `closed` is the count with which the store was closed, and -1 while it is open.

INSERT INTO sequence (name, next) VALUES ('commit', 0), ('store', random()), ('closed', -1);
