//! What a descriptor depends on, as text; and what of it changes when a map is given another head.
//!
//! ```text
//! dinov2-vits14:0f1e2d3c4b5a:b8 : 448x336 : t1 : k400-200-50 : gem3 : h0123456789ab
//! preset, weights, exit block     input     key patches        pooling  head
//! ```
//!
//! The pooling is left out where it is the mean, as it was before there was a choice.

use super::aggregate::Aggregate;
use super::config::ExtractConfig;
use super::encoder::EncoderSpec;
use super::error::ExtractError;
use super::head::Head;
use super::weights::VitWeights;
use placeformer_core::types::{ModelId, PoolingStride};

const HEAD_MARK: &str = ":h";

/// Preset, weights, heads where they are not the preset's, exit block with an `n` for normed
/// tokens: `dinov2-vits14:0f1e2d3c4b5a:b8`. A head depends on these and nothing else.
pub(super) fn backbone_id(
    config: &ExtractConfig,
    spec: &EncoderSpec,
    weights: &VitWeights,
) -> String {
    let heads = match weights.geometry.heads {
        heads if heads == config.preset.geometry().heads => String::new(),
        heads => format!(":heads{heads}"),
    };
    let norm = if spec.token_norm { "n" } else { "" };
    format!(
        "{}:{}{heads}:b{}{norm}",
        config.preset,
        &weights.content_hash()[..12],
        spec.exit_block
    )
}

/// The backbone, then everything else a descriptor depends on. The precision is left out on
/// purpose: descriptors of one model compare across precisions.
pub(super) fn compose(
    backbone: &str,
    config: &ExtractConfig,
    spec: &EncoderSpec,
    head: Option<&Head>,
) -> ModelId {
    let attention = match spec.attention_block {
        block if block == spec.exit_block => String::new(),
        block => format!(":a{block}"),
    };
    let stride = if config.stride == PoolingStride::Kernel {
        ""
    } else {
        ":dense"
    };
    let caps = config.caps.map(|cap| cap.to_string()).join("-");
    let size = spec.input_size;
    let without_head = format!(
        "{backbone}:{size}{attention}:t{}:k{caps}{stride}",
        config.tau
    );
    ModelId::new(match head {
        Some(head) => with_head(&without_head, head),
        None => format!("{without_head}{HEAD_MARK}none"),
    })
}

fn with_head(without_head: &str, head: &Head) -> String {
    let pooling = match head.aggregate() {
        Aggregate::Mean => String::new(),
        other => format!(":{other}"),
    };
    format!(
        "{without_head}{pooling}{HEAD_MARK}{}",
        &head.content_hash()[..12]
    )
}

impl Head {
    /// The identity of a map of `model` once its pooled vectors have passed through this head.
    ///
    /// # Errors
    /// The map's tokens come from another backbone, or its pooled vectors were pooled otherwise
    /// than this head needs.
    pub fn rebind(&self, model: &ModelId) -> Result<ModelId, ExtractError> {
        let other_tokens = || ExtractError::HeadMismatch {
            path: None,
            head_backbone: self.backbone().to_owned(),
            backbone: model.to_string(),
        };
        let (kept, _) = model
            .as_str()
            .rsplit_once(HEAD_MARK)
            .ok_or_else(other_tokens)?;
        let settings = kept
            .strip_prefix(self.backbone())
            .and_then(|rest| rest.strip_prefix(':'));
        let settings = settings.ok_or_else(other_tokens)?;
        let is_pooling = |part: &&str| part.starts_with("gem") || part.starts_with("vlad");
        let stored = settings.split(':').next_back().filter(is_pooling);
        let without_head = match stored {
            Some(stored) => &kept[..kept.len() - stored.len() - 1],
            None => kept,
        };
        let (stored, own) = (stored.unwrap_or("mean"), self.aggregate().to_string());
        if stored != own {
            return Err(ExtractError::AggregateMismatch {
                stored: stored.to_owned(),
                head: own,
            });
        }
        Ok(ModelId::new(with_head(without_head, self)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::aggregate::VladWords;
    use super::*;
    use placeformer_core::types::GLOBAL_DIM;

    const BACKBONE: &str = "dinov2-vits14:0f1e2d3c4b5a:b8";

    fn head(aggregate: Aggregate, seed: f32) -> Head {
        let weight = vec![seed; GLOBAL_DIM * aggregate.pooled_dim(4)];
        Head::new(
            aggregate,
            weight,
            vec![0.5; GLOBAL_DIM],
            BACKBONE,
            [].into(),
        )
        .unwrap()
    }

    fn kinds() -> [Aggregate; 4] {
        let vlad = |value| Aggregate::Vlad(VladWords::new(vec![value; 8], 4).unwrap());
        [
            Aggregate::Mean,
            Aggregate::gem(3.0).unwrap(),
            Aggregate::gem(2.5).unwrap(),
            vlad(0.5),
        ]
    }

    #[test]
    fn a_map_takes_heads_of_its_own_pooling_and_no_others() {
        let (config, spec) = (
            ExtractConfig::default(),
            ExtractConfig::default().encoder_spec().unwrap(),
        );
        for (i, stored) in kinds().into_iter().enumerate() {
            let old = compose(BACKBONE, &config, &spec, Some(&head(stored.clone(), 1.0)));
            for (k, offered) in kinds().into_iter().enumerate() {
                let new = head(offered.clone(), 2.0);
                match new.rebind(&old) {
                    // The very identity a server with the new head has.
                    Ok(id) => {
                        assert_eq!((i, id), (k, compose(BACKBONE, &config, &spec, Some(&new))))
                    }
                    Err(ExtractError::AggregateMismatch {
                        stored: named,
                        head,
                    }) => {
                        assert!(
                            i != k && named == stored.to_string() && head == offered.to_string()
                        );
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
