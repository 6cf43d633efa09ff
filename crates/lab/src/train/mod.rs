//! Learning the head and the backbone (paper III-F): the other half of the method.
//!
//! ```text
//! data set --triplets--> positives within 10 m, the rest beyond 25 m
//!    cycle: draw the queries, embed them, their positives and a pool --mining--> hardest negatives of each query
//!           N steps of triplets --loss--> --adam--> weights      (learning rate by schedule)
//!           validation recall --> best weights kept, stop when it no longer improves
//!           checkpoint (weights, moments, counters), log line
//! ```
//!
//! A cycle depends only on the checkpoint it starts from and on the seed: every random choice is
//! drawn from `(seed, step, position)`, and hard negatives are mined anew from the weights the
//! cycle starts with. So a run that was interrupted continues from its last cycle bit for bit as if
//! it had not been.
//!
//! | module | holds |
//! |---|---|
//! | `triplets` | which images are positives, which may be negatives |
//! | `holdout` | which places are kept back for validation |
//! | `mining` | the negatives that look most like the query |
//! | `loss`, `adam`, `schedule` | one step |
//! | `head`, `backbone` | the two things that can be trained |
//! | `pooled_cache` | what a head is trained on, kept on disk |
//! | `augment` | photometric and geometric variation of training images |
//! | `trainer`, `config`, `checkpoint`, `log` | the loop, its settings, its memory and its diary |
//! | [`report`] | the run as a page |

mod adam;
mod augment;
mod backbone;
mod checkpoint;
mod config;
mod error;
mod head;
mod holdout;
mod log;
mod loss;
mod mining;
mod pooled_cache;
pub mod report;
mod schedule;
mod trainer;
mod triplets;

pub use augment::{Augmentation, augment};
pub use backbone::{BackboneModel, TrainableBlocks};
pub use config::{TrainConfig, ValidationRecall};
pub use error::TrainError;
pub use head::{HeadModel, PooledTokens};
pub use holdout::{Drives, Holdout};
pub use log::{CycleRecord, read_log};
pub use pooled_cache::PooledCache;
pub use schedule::Schedule;
pub use trainer::{Outcome, Progress, Session};
pub use triplets::{Side, TripletSet};
