//! What every place store must do, asked of the embedded one through its public interface.

#[path = "../../../../tests/common/places.rs"]
mod places;
#[path = "../../../../tests/common/small_disk.rs"]
mod small_disk;
mod support;

mod combined;
mod damage;
mod full_disk;
mod killed;
mod lost_storage;
mod lost_tail;
mod maps;
mod opening;
mod references;
