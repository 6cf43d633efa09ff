//! Flags of the method, and the two recipes that say what is meant where a flag is left out.

use crate::cli::choice::choice;
use anyhow::ensure;
use clap::ValueEnum;
use placeformer_lab::train::{
    Augmentation, Finish, Keep, Loss, LossKind, Schedule, TrainConfig, TrainableBlocks,
};
use placeformer_vision::extract::NetVladShape;

/// What is meant where flags are left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub(super) enum Recipe {
    /// The paper's: triplets under the mean of the tokens, images varied anew at every step.
    #[default]
    Paper,
    /// For photographs of a city with positions and headings: InfoNCE over batches of pairs, the
    /// last three blocks under a NetVLAD, averaged with the start and fitted again.
    Streets,
}

/// What a run writes besides the head.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Written {
    /// All weights of the backbone.
    Weights,
    /// The difference to the weights that training started from.
    Difference,
}

/// Which weights come out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
enum Kept {
    /// Those with the best validation recall.
    #[default]
    Best,
    /// Those after the last step.
    Last,
}

/// How it is trained.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Method (defaults: of --recipe paper, of --recipe streets)")]
pub(super) struct MethodArgs {
    /// What is meant where other flags are left out.
    #[arg(long, value_enum, default_value_t)]
    pub(super) recipe: Recipe,
    /// What is minimised [default: triplet, info-nce].
    #[arg(long, value_parser = choice::<LossKind>())]
    loss: Option<LossKind>,
    /// Margin of the triplet loss on squared distances (paper: 0.01).
    #[arg(long, default_value_t = 0.01)]
    margin: f64,
    /// Temperature of InfoNCE.
    #[arg(long, default_value_t = 0.07)]
    temperature: f64,
    /// Steps of the whole run, unless validation stops improving before [default: 5000, 150].
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Steps of growing learning rate before the cosine falls [default: 100, 20; at most a tenth,
    /// an eighth of the steps].
    #[arg(long, value_name = "N")]
    warm_up: Option<u64>,
    /// Highest learning rate of the transformer, and of all else unless it has its own (paper:
    /// 5e-4) [default: 5e-4, 5e-5].
    #[arg(long, value_name = "RATE")]
    learning_rate: Option<f64>,
    /// Highest learning rate of the aggregate [default: the transformer's, 3e-4].
    #[arg(long, value_name = "RATE")]
    aggregate_rate: Option<f64>,
    /// Highest learning rate of the head's projection [default: the transformer's, 1e-4].
    #[arg(long, value_name = "RATE")]
    projection_rate: Option<f64>,
    /// Share of every weight that a step takes away, by its learning rate [default: 0, 0.01].
    #[arg(long, value_name = "SHARE")]
    weight_decay: Option<f64>,
    /// Greatest length of a step's gradients, to which longer ones are shortened [default: none,
    /// 1].
    #[arg(long, value_name = "LENGTH")]
    longest_gradient: Option<f64>,
    /// Triplets of a step; pairs of a query and a positive for the other losses [default: 16, 40].
    #[arg(long, value_name = "N")]
    batch: Option<usize>,
    /// Pairs of the batch that are added to each drawn one because they look like it (not with
    /// triplets).
    #[arg(long, default_value_t = 1, value_name = "N")]
    hard_pairs: usize,
    /// Most images in a graph at once on each thread. It bounds the memory, and costs one more
    /// forward pass where a step has more [default: all, 4].
    #[arg(long, value_name = "N")]
    images_at_once: Option<usize>,
    /// Steps between two minings of hard negatives; also between validations and checkpoints
    /// [default: 100, 50].
    #[arg(long, value_name = "STEPS")]
    mine_every: Option<u64>,
    /// Hardest negatives of each query, one of which is drawn [default: 10, 20].
    #[arg(long, value_name = "N")]
    negatives: Option<usize>,
    /// Most images compared when mining, drawn anew each time.
    #[arg(long, default_value_t = 20_000, value_name = "N")]
    mining_pool: usize,
    /// Minings without a better validation recall (mean of R@1 and R@10) after which the run stops.
    #[arg(long, default_value_t = 8, value_name = "N")]
    patience: u32,
    /// Which weights come out: those with the best validation recall, or those after the last step.
    #[arg(long, value_enum, default_value_t)]
    keep: Kept,
    /// Where every random choice comes from, the held-out blocks too.
    #[arg(long, default_value_t = 0)]
    pub(super) seed: u64,
}

/// What goes with the training of blocks only.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Blocks (not with --trainable head)")]
pub(super) struct BlockArgs {
    /// Rank of the adapters that are trained in the place of the blocks' matrices; they need a
    /// higher --learning-rate, such as 1e-3 [default: the blocks themselves].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=384))]
    pub(super) rank: Option<u16>,
    /// Share of the trained weights in the result; the rest is of those that training started from
    /// [default: 1, 0.75].
    #[arg(long, value_name = "SHARE")]
    average: Option<f64>,
    /// Fit the projection anew at the end, as a PCA whitened to this power, or keep the trained one:
    /// a number or none [default: none, 0.75].
    #[arg(long, value_name = "POWER", value_parser = parse_refit)]
    refit: Option<Refit>,
    /// Most training images behind the PCA that is fitted for each validation.
    #[arg(long, default_value_t = 1024, value_name = "N")]
    fit_images: usize,
    /// Keep the tokens before the first trained block on disk, of each training image in this many
    /// views: the image itself, and variations of it. With 0 every image passes the whole
    /// transformer at every step, varied anew [default: 0, 1].
    #[arg(long, value_name = "N")]
    cached_views: Option<usize>,
    /// Folder of those tokens [default: in the user's cache].
    #[arg(long, value_name = "DIR")]
    pub(super) token_cache: Option<std::path::PathBuf>,
    /// What is written besides the head [default: weights, difference].
    #[arg(long, value_enum)]
    written: Option<Written>,
    /// Visual words of the NetVLAD that --recipe streets starts from, unless --head names a file.
    #[arg(long, default_value_t = NetVladShape::default().words, value_name = "N")]
    words: usize,
    /// Width to which it projects tokens.
    #[arg(long, default_value_t = NetVladShape::default().width, value_name = "N")]
    token_width: usize,
    /// How strongly its tokens prefer the word that they are most alike. Training begins softer than
    /// a NetVLAD that is only fitted.
    #[arg(long, default_value_t = 10.0, value_name = "X")]
    sharpness: f32,
}

/// Whether the projection is fitted again, and to which power.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Refit(Option<f64>);

fn parse_refit(text: &str) -> Result<Refit, String> {
    match text {
        "none" => Ok(Refit(None)),
        number => match number.parse() {
            Ok(power) => Ok(Refit(Some(power))),
            Err(_) => Err("use none, or a power such as 0.75".into()),
        },
    }
}

/// Variation of the images when blocks are trained; pooled tokens of a head's training cannot be
/// varied.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Augmentation (not with --trainable head)")]
pub(super) struct AugmentArgs {
    /// Brightness factor within 1 +- this [default: 0.3].
    #[arg(long, value_name = "SHARE")]
    brightness: Option<f32>,
    /// Contrast factor within 1 +- this [default: 0.3].
    #[arg(long, value_name = "SHARE")]
    contrast: Option<f32>,
    /// Saturation factor within 1 +- this [default: 0.3].
    #[arg(long, value_name = "SHARE")]
    saturation: Option<f32>,
    /// Corners of the view move by up to this share of the sides [default: 0.08].
    #[arg(long, value_name = "SHARE")]
    viewpoint: Option<f32>,
}

impl AugmentArgs {
    pub(super) fn is_unset(&self) -> bool {
        [
            self.brightness,
            self.contrast,
            self.saturation,
            self.viewpoint,
        ]
        .iter()
        .all(Option::is_none)
    }

    fn strengths(&self) -> Augmentation {
        let default = Augmentation::default();
        Augmentation {
            brightness: self.brightness.unwrap_or(default.brightness),
            contrast: self.contrast.unwrap_or(default.contrast),
            saturation: self.saturation.unwrap_or(default.saturation),
            viewpoint: self.viewpoint.unwrap_or(default.viewpoint),
        }
    }
}

impl Recipe {
    /// The value of this recipe.
    pub(super) fn pick<T>(self, paper: T, streets: T) -> T {
        match self {
            Self::Paper => paper,
            Self::Streets => streets,
        }
    }
}

impl MethodArgs {
    /// The settings of training a head alone, checked before anything slow begins.
    pub(super) fn head_config(&self) -> anyhow::Result<TrainConfig> {
        self.config(Augmentation::NONE, Finish::default())
    }

    /// The settings of training blocks, checked before anything slow begins.
    pub(super) fn block_config(
        &self,
        blocks: &BlockArgs,
        augment: &AugmentArgs,
    ) -> anyhow::Result<TrainConfig> {
        let views = blocks.cached_views(self.recipe);
        ensure!(
            views != 1 || augment.is_unset(),
            "one cached view is the image itself, which does not vary: leave the augmentation flags \
             out, or give --cached-views 0 or more than 1"
        );
        let augmentation = match views {
            1 => Augmentation::NONE,
            _ => augment.strengths(),
        };
        let finish = Finish {
            average: blocks.average.unwrap_or(self.recipe.pick(1.0, 0.75)),
            whitening: match blocks.refit {
                Some(Refit(power)) => power,
                None => self.recipe.pick(None, Some(0.75)),
            },
            fit_images: blocks.fit_images,
        };
        self.config(augmentation, finish)
    }

    fn config(&self, augmentation: Augmentation, finish: Finish) -> anyhow::Result<TrainConfig> {
        let recipe = self.recipe;
        let steps = self.steps.unwrap_or(recipe.pick(5000, 150));
        let warm_up = recipe.pick((steps / 10).min(100), (steps / 8).min(20));
        let kind = self
            .loss
            .unwrap_or(recipe.pick(LossKind::Triplet, LossKind::InfoNce));
        let loss = match kind {
            LossKind::Triplet => Loss::Triplet {
                margin: self.margin,
            },
            LossKind::InfoNce => Loss::InfoNce {
                temperature: self.temperature,
            },
            LossKind::MultiSimilarity => Loss::MultiSimilarity,
        };
        let config = TrainConfig {
            loss,
            schedule: Schedule {
                peak: self.learning_rate.unwrap_or(recipe.pick(5e-4, 5e-5)),
                warm_up: self.warm_up.unwrap_or(warm_up),
                total: steps,
            },
            aggregate_rate: self.aggregate_rate.or(recipe.pick(None, Some(3e-4))),
            projection_rate: self.projection_rate.or(recipe.pick(None, Some(1e-4))),
            weight_decay: self.weight_decay.unwrap_or(recipe.pick(0.0, 0.01)),
            longest_gradient: self.longest_gradient.or(recipe.pick(None, Some(1.0))),
            batch: self.batch.unwrap_or(recipe.pick(16, 40)),
            hard_pairs: self.hard_pairs,
            images_at_once: self.images_at_once.or(recipe.pick(None, Some(4))),
            steps_per_cycle: self.mine_every.unwrap_or(recipe.pick(100, 50)),
            negatives: self.negatives.unwrap_or(recipe.pick(10, 20)),
            mining_pool: self.mining_pool,
            patience: self.patience,
            keep: match self.keep {
                Kept::Best => Keep::Best,
                Kept::Last => Keep::Last,
            },
            augmentation,
            finish,
            seed: self.seed,
        };
        config.check()?;
        Ok(config)
    }
}

impl BlockArgs {
    /// Whether no flag was given that asks for the training of blocks.
    pub(super) fn is_unset(&self) -> bool {
        self.rank.is_none()
            && self.average.is_none()
            && self.refit.is_none()
            && self.cached_views.is_none()
            && self.written.is_none()
    }

    pub(super) fn cached_views(&self, recipe: Recipe) -> usize {
        self.cached_views.unwrap_or(recipe.pick(0, 1))
    }

    pub(super) fn written(&self, recipe: Recipe) -> Written {
        let default = recipe.pick(Written::Weights, Written::Difference);
        self.written.unwrap_or(default)
    }

    /// The NetVLAD that training starts from where no head is named.
    pub(super) fn starting_shape(&self) -> NetVladShape {
        NetVladShape {
            words: self.words,
            width: self.token_width,
            sharpness: self.sharpness,
        }
    }
}

/// The blocks that a recipe trains, where it is not said.
pub(super) const STREET_BLOCKS: TrainableBlocks = TrainableBlocks::Last(3);

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        method: MethodArgs,
        #[command(flatten)]
        blocks: BlockArgs,
        #[command(flatten)]
        augment: AugmentArgs,
    }

    fn config(arguments: &str) -> anyhow::Result<TrainConfig> {
        let words = std::iter::once("train").chain(arguments.split_whitespace());
        let command = Command::try_parse_from(words)?;
        command
            .method
            .block_config(&command.blocks, &command.augment)
    }

    #[test]
    fn the_paper_is_what_is_meant_unless_another_recipe_is_named() {
        let paper = config("").unwrap();
        assert_eq!(paper, TrainConfig::default());
        let streets = config("--recipe streets").unwrap();
        assert_eq!(streets.loss, Loss::InfoNce { temperature: 0.07 });
        assert_eq!(
            (streets.schedule.total, streets.schedule.warm_up),
            (150, 18)
        );
        assert_eq!((streets.batch, streets.images_at_once), (40, Some(4)));
        assert_eq!(streets.augmentation, Augmentation::NONE);
        assert_eq!(
            (streets.finish.average, streets.finish.whitening),
            (0.75, Some(0.75))
        );
    }

    #[test]
    fn flags_win_over_the_recipe() {
        let config = config(
            "--recipe streets --loss multi-similarity --steps 10 --refit none --average 1 \
             --cached-views 3 --viewpoint 0.1 --aggregate-rate 1e-3",
        )
        .unwrap();
        assert_eq!(config.loss, Loss::MultiSimilarity);
        assert_eq!((config.schedule.total, config.schedule.warm_up), (10, 1));
        assert!(!config.finish.changes());
        assert_eq!(config.augmentation.viewpoint, 0.1);
        assert_eq!(config.aggregate_rate, Some(1e-3));
    }

    #[test]
    fn what_does_not_go_together_is_refused() {
        for (arguments, part) in [
            ("--recipe streets --brightness 0.2", "does not vary"),
            ("--refit half", "use none"),
            ("--average 2", "trained weights"),
            ("--recipe streets --temperature 0", "temperature"),
        ] {
            let error = config(arguments).unwrap_err().to_string();
            assert!(error.contains(part), "{arguments}: {error}");
        }
    }
}
