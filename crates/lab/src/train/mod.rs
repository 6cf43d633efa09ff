//! Learning the head and the backbone (paper III-F): the other half of the method.
//!
//! ```text
//! data set --triplets--> positives within 10 m, the rest beyond 25 m
//!    cycle: draw the queries; embed them, their positives and a pool
//!           --mining--> the hardest negatives of each query
//!           N steps of triplets --loss--> --adam--> weights  (learning rate by schedule)
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
//! | `sources`, `triplets` | the images; which are positives, which may be negatives |
//! | `holdout` | which places are kept back for validation |
//! | `mining` | the negatives that look most like the query |
//! | `spots`, `pairs` | what any two images are to each other; batches of pairs |
//! | `embed`, `validation` | descriptors of many images; recall on held-out places |
//! | `cycle`, `loss`, `adam`, `schedule` | the steps between two minings |
//! | `gradients` | of a loss over more images than fit in memory at once |
//! | `model`, `head`, `backbone` | what can be trained: the head, or blocks of the backbone too |
//! | `weights`, `transformer`, `pooling`, `ops` | the computation of `backbone`, differentiable |
//! | `averaged` | what would come out: averaged with the start, projection fitted again |
//! | `token_cache` | tokens before the trained blocks, kept on disk |
//! | `fit` | a head without labels, to start from |
//! | `pooled_cache` | what a head is trained on, kept on disk |
//! | `augment` | photometric and geometric variation of training images |
//! | `trainer`, `config`, `checkpoint`, `log` | the loop, its settings, its memory and its diary |
//! | [`report`] | the run as a page |

mod adam;
mod augment;
mod averaged;
mod backbone;
mod checkpoint;
mod config;
mod cycle;
mod embed;
mod error;
mod fit;
mod gradients;
mod head;
mod holdout;
#[cfg(test)]
mod interruption;
mod log;
mod loss;
mod mining;
mod model;
mod ops;
mod pairs;
mod pooled_cache;
mod pooling;
pub mod report;
mod schedule;
mod sources;
mod spots;
mod token_cache;
mod trainer;
mod transformer;
mod triplets;
mod validation;
mod weights;

pub use augment::{Augmentation, augment};
pub use backbone::{BackboneModel, TokenSource, Trainable, TrainableBlocks};
pub use config::{Finish, Keep, TrainConfig, ValidationRecall};
pub use error::TrainError;
pub use fit::{AggregateChoice, FittedHead, SetTokens, fit_head, starting_head};
pub use head::{HeadModel, PooledTokens};
pub use holdout::{Drives, Holdout};
pub use log::{CycleRecord, read_log};
pub use loss::{Loss, LossKind};
pub use pooled_cache::PooledCache;
pub use schedule::Schedule;
pub use sources::{Sources, TripletRule, refuse_shared_images};
pub use spots::{Reach, Relation, Spot, Spots};
pub use token_cache::{TokenCache, TokenCacheConfig, distinct_images};
pub use trainer::{Outcome, Session};
pub use triplets::{Side, TripletSet};
