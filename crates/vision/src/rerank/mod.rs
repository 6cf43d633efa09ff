//! Key patches of a query against those of its candidates: mutual nearest neighbours, homography,
//! score (paper III-D and III-E).
//!
//! Two photographs of one place have many patches that look alike and lie alike. Descriptors tell
//! which patches look alike; a homography that most of these pairs agree with tells whether they
//! lie alike. The number of pairs that agree is the score by which candidates are ranked.
//!
//! | module | step of the paper |
//! |---|---|
//! | `mutual_nn` | 6: pairs of patches that are each other's nearest |
//! | `ransac`, `frame`, `proper_samples`, `refine` | 7: the homography that most pairs agree with |
//! | `view` | which homographies a camera can cause |
//! | `score` | 8: inliers added up over the configured combinations of scales |
//! | `features` | what else is learned about a pair |
//! | `reranker` | all candidates of a query, in parallel |
//! | `ranking` | what candidates are ordered by |
//! | `config`, `outcome` | what goes in, and what comes out |
//!
//! Each thread keeps its working memory, so scoring a candidate allocates only its answer.

mod config;
mod features;
mod frame;
mod mutual_nn;
mod outcome;
mod proper_samples;
mod ranking;
mod ransac;
mod refine;
mod reranker;
mod score;
#[cfg(test)]
mod tests;
mod view;

pub use config::RerankConfig;
pub use outcome::{
    CombinationFeatures, CombinationMatch, CombinationScore, Correspondence, HomographyFeatures,
    PairFeatures, PairScore, Ranked, Reranked,
};
pub use ranking::{Evidence, Ranking, feature_names, feature_vectors};
pub use reranker::Reranker;
