//! The identity of a model: everything that its descriptors depend on, as text.
//!
//! Descriptors of two different models must never be compared, so a map is bound to one identity:
//!
//! ```text
//! dinov2-vits14:0f1e2d3c4b5a:b8 : 448x336 : t1 : k400-200-50 : gem3 : h0123456789ab
//! preset, weights, exit block     input     key patches        pooling  head
//! ```
//!
//! Weights with which a difference was merged are named by the hash of those before, and the
//! difference by its own: `dinov2-vits14:0f1e2d3c4b5a:d112233445566:b8`.
//!
//! The pooling is left out if it is the mean, so that models made before there was a choice keep
//! their identity. The precision is left out, because descriptors compare across precisions. When a
//! map is given another head, only the last part changes ([`Head::rebind`]).

use super::aggregate::Aggregate;
use super::config::ExtractConfig;
use super::encoder::EncoderSpec;
use super::error::ExtractError;
use super::head::Head;
use super::weights::VitWeights;
use placeformer_core::types::{ModelId, PoolingStride};

/// What the head's part of an identity begins with.
const HEAD_MARK: &str = ":h";

/// Hexadecimal digits of a hash that are part of an identity.
const HASH_DIGITS: usize = 12;

/// The part of the identity that tokens depend on: preset, weights, difference, number of heads if
/// it is not the preset's, exit block, and `n` if tokens pass the final LayerNorm. A head depends
/// on exactly this.
pub(super) fn backbone_id(
    config: &ExtractConfig,
    spec: &EncoderSpec,
    weights: &VitWeights,
) -> String {
    let preset = config.preset;
    let hash = weights_id(weights);
    let heads = weights.geometry.heads;
    let heads = if heads == preset.geometry().heads {
        String::new()
    } else {
        format!(":heads{heads}")
    };
    let block = spec.exit_block;
    let norm = if spec.token_norm { "n" } else { "" };
    format!("{preset}:{hash}{heads}:b{block}{norm}")
}

/// Hash of the weights; of merged ones the hash of those before and of the difference.
fn weights_id(weights: &VitWeights) -> String {
    let start = |hash: &str| hash[..HASH_DIGITS].to_owned();
    match &weights.merged {
        None => start(&weights.content_hash()),
        Some(merged) => {
            let base = start(&merged.base);
            let difference = start(&merged.difference);
            format!("{base}:d{difference}")
        }
    }
}

/// The whole identity.
pub(super) fn compose(
    backbone: &str,
    config: &ExtractConfig,
    spec: &EncoderSpec,
    head: Option<&Head>,
) -> ModelId {
    let size = spec.input_size;
    let attention = if spec.attention_block == spec.exit_block {
        String::new()
    } else {
        format!(":a{}", spec.attention_block)
    };
    let tau = config.tau;
    let caps = config.caps.map(|cap| cap.to_string()).join("-");
    let stride = match config.stride {
        PoolingStride::Kernel => "",
        PoolingStride::One => ":dense",
    };
    let without_head = format!("{backbone}:{size}{attention}:t{tau}:k{caps}{stride}");
    ModelId::new(match head {
        Some(head) => with_head(&without_head, head),
        None => format!("{without_head}{HEAD_MARK}none"),
    })
}

/// Appends the parts of pooling and head.
fn with_head(without_head: &str, head: &Head) -> String {
    let pooling = match head.aggregate() {
        Aggregate::Mean => String::new(),
        other => format!(":{other}"),
    };
    let hash = head.content_hash();
    let hash = &hash[..HASH_DIGITS];
    format!("{without_head}{pooling}{HEAD_MARK}{hash}")
}

impl Head {
    /// The identity that a map of `model` has once its pooled vectors were projected by this head.
    ///
    /// # Errors
    /// [`ExtractError::HeadMismatch`] if the map's tokens come from another backbone;
    /// [`ExtractError::AggregateMismatch`] if they were pooled in another way than this head needs.
    pub fn rebind(&self, model: &ModelId) -> Result<ModelId, ExtractError> {
        let identity = parse(model.as_str(), self.backbone());
        let identity = identity.ok_or_else(|| ExtractError::HeadMismatch {
            path: None,
            head_backbone: self.backbone().to_owned(),
            backbone: model.to_string(),
        })?;
        let needed = self.aggregate().to_string();
        if identity.pooling != needed {
            return Err(ExtractError::AggregateMismatch {
                stored: identity.pooling.to_owned(),
                head: needed,
            });
        }
        Ok(ModelId::new(with_head(identity.without_head, self)))
    }
}

/// The parts of an identity that matter to a new head.
struct ParsedIdentity<'a> {
    /// Everything before pooling and head.
    without_head: &'a str,
    /// The pooling; `mean` if none is written.
    pooling: &'a str,
}

/// Takes an identity apart; `None` if it does not begin with `backbone`, or has no head part.
fn parse<'a>(identity: &'a str, backbone: &str) -> Option<ParsedIdentity<'a>> {
    let (before_head, _) = identity.rsplit_once(HEAD_MARK)?;
    // The colon keeps `...:b8` from matching `...:b80`.
    let settings = before_head.strip_prefix(backbone)?.strip_prefix(':')?;
    let last = settings.rsplit(':').next().unwrap_or(settings);
    let poolings = ["gem", "vlad", "netvlad"];
    if poolings.iter().any(|pooling| last.starts_with(pooling)) {
        let without_pooling = before_head.len() - last.len() - 1;
        Some(ParsedIdentity {
            without_head: &before_head[..without_pooling],
            pooling: last,
        })
    } else {
        Some(ParsedIdentity {
            without_head: before_head,
            pooling: "mean",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::extract::netvlad::{NetVlad, NetVladParameters};
    use crate::extract::vlad::VladWords;
    use placeformer_core::types::GLOBAL_DIM;

    const BACKBONE: &str = "dinov2-vits14:0f1e2d3c4b5a:b8";

    fn head(aggregate: Aggregate, seed: f32) -> Head {
        let weight = (0..GLOBAL_DIM * aggregate.pooled_dim(4))
            .map(|i| seed + (i * 37 % 101) as f32)
            .collect();
        Head::new(
            aggregate,
            weight,
            vec![0.5; GLOBAL_DIM],
            BACKBONE,
            [].into(),
        )
        .unwrap()
    }

    fn kinds() -> [Aggregate; 5] {
        let vlad = |value| Aggregate::Vlad(VladWords::new(vec![value; 8], 4).unwrap());
        let netvlad = NetVlad::new(NetVladParameters {
            mean: vec![0.1; 4],
            projection: vec![0.5; 8],
            words: vec![0.25; 4],
            assignment: vec![2.0; 4],
        });
        [
            Aggregate::NetVlad(Box::new(netvlad.unwrap())),
            Aggregate::Mean,
            Aggregate::gem(3.0).unwrap(),
            Aggregate::gem(2.5).unwrap(),
            vlad(0.5),
        ]
    }

    #[test]
    fn a_map_takes_heads_of_its_own_pooling_and_no_others() {
        let config = ExtractConfig::default();
        let spec = config.encoder_spec().unwrap();
        for (i, stored) in kinds().into_iter().enumerate() {
            let old = compose(BACKBONE, &config, &spec, Some(&head(stored.clone(), 1.0)));
            for (k, offered) in kinds().into_iter().enumerate() {
                let new = head(offered.clone(), 2.0);
                match new.rebind(&old) {
                    // The map then has the identity of a server that starts with the new head.
                    Ok(id) => {
                        let expected = compose(BACKBONE, &config, &spec, Some(&new));
                        assert_eq!((i, id), (k, expected));
                    }
                    Err(ExtractError::AggregateMismatch {
                        stored: named,
                        head,
                    }) => {
                        assert_ne!(i, k);
                        assert_eq!(named, stored.to_string());
                        assert_eq!(head, offered.to_string());
                    }
                    Err(other) => panic!("{other}"),
                }
            }
        }
    }

    #[test]
    fn other_tokens_are_refused() {
        let head = head(Aggregate::Mean, 1.0);
        for model in [
            "dinov2-vits14:0f1e2d3c4b5a:b80:448x336:t1:k1-1-1:habc",
            "dinov2-vits14",
            "x:h",
            "",
        ] {
            let error = head.rebind(&ModelId::new(model)).unwrap_err();
            assert!(
                matches!(error, ExtractError::HeadMismatch { .. }),
                "{model}: {error}"
            );
        }
    }
}
