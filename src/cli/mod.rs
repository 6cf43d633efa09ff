//! The command line: one file per subcommand.
//!
//! Without the feature `lab` there are only the commands that run, fill and inspect a server.

pub mod backup;
#[cfg(feature = "lab")]
pub mod bench;
#[cfg(feature = "lab")]
mod child_server;
#[cfg(feature = "lab")]
mod choice;
mod client;
#[cfg(feature = "lab")]
mod data_args;
#[cfg(feature = "lab")]
pub mod demo;
#[cfg(feature = "lab")]
pub mod eval;
pub mod extract;
#[cfg(feature = "lab")]
pub mod head;
pub mod healthcheck;
pub mod import;
pub mod load;
pub mod map;
#[cfg(feature = "lab")]
pub mod match_images;
pub mod model;
pub mod model_args;
pub mod openapi;
pub mod output;
mod progress;
pub mod query;
pub mod serve;
#[cfg(feature = "lab")]
pub mod synth;
#[cfg(feature = "lab")]
pub mod train;
pub mod verify;

use clap::{Parser, Subcommand};

/// Visual place recognition: which mapped place does this photo show?
#[derive(Debug, Parser)]
#[command(name = "placeformer", version, arg_required_else_help = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
#[allow(clippy::large_enum_variant, reason = "one value, parsed once")]
pub enum Command {
    /// Run the service.
    Serve(serve::ServeArgs),
    /// Import a folder of photos into a map.
    Import(import::ImportArgs),
    /// Ask which place a photo shows.
    Query(query::QueryArgs),
    /// Match two images and draw the evidence.
    #[cfg(feature = "lab")]
    Match(match_images::MatchArgs),
    /// Show every intermediate of extraction.
    Extract(extract::ExtractArgs),
    /// Obtain and inspect models.
    Model(model::ModelArgs),
    /// Fit or train the projection to the global descriptor.
    #[cfg(feature = "lab")]
    Head(head::HeadArgs),
    /// Measure recall on a data set.
    #[cfg(feature = "lab")]
    Eval(eval::EvalArgs),
    /// Train the model: its head, or blocks of the backbone too.
    ///
    /// Triplets are formed from positions (positives within 10 m, negatives beyond 25 m) or from
    /// the order of frames; before every cycle of steps the hardest negatives are found again.
    /// After every cycle recall is measured on places that are not learnt from, the best weights
    /// are kept, and a checkpoint is written: the same command in the same folder goes on from it,
    /// bit for bit as if nothing had happened.
    ///
    /// The run's folder holds train.jsonl (a line a cycle), checkpoint.safetensors, and at the end
    /// head.safetensors, report.html and, where blocks were trained, weights.safetensors. Use them
    /// with --weights and --head, or name the head in a server's configuration (extract.head). `map
    /// rehead` brings a map over to a new head without its images.
    ///
    /// With --head none the head starts as a half-whitened PCA of the training images (more than
    /// 256 of them).
    #[cfg(feature = "lab")]
    Train(train::TrainArgs),
    /// Render synthetic street scenes.
    #[cfg(feature = "lab")]
    Synth(synth::SynthArgs),
    /// Serve a demo map, query it, write a report.
    #[cfg(feature = "lab")]
    Demo(demo::DemoArgs),
    /// Measure every stage beside its baselines.
    #[cfg(feature = "lab")]
    Bench(bench::BenchArgs),
    /// Drive a server at a constant rate.
    Load(load::LoadArgs),
    /// Check every record of a store.
    ///
    /// A store whose database lacks commits that were acknowledged is not opened: its log was cut
    /// short or deleted, or an older database was put in its place. The message says how many are
    /// missing and since when; --accept-lost-tail gives them up.
    ///
    /// What it cannot see: records that were exchanged together with their checksums; the loss of
    /// the database, its log and the file commit-mark together, or the exchange of all three for
    /// those of an earlier moment. In a log that vanished while it was being folded into the
    /// database, a commit may be there in part; that is found by reading, as any other damage.
    Verify(verify::VerifyArgs),
    /// Copy a store, also while a server runs on it.
    ///
    /// The copy is of one moment: every reference acknowledged before the command began is in it.
    Backup(backup::BackupArgs),
    /// Ask a running server whether it is ready.
    Healthcheck(healthcheck::HealthcheckArgs),
    /// Print the OpenAPI document.
    Openapi(openapi::OpenapiArgs),
    /// Inspect and change maps; give them another head.
    Map(map::MapArgs),
}

impl Cli {
    /// Runs the subcommand to its end.
    pub fn run(self) -> anyhow::Result<()> {
        // Fails only if one is installed already, which is as good.
        let _ = rustls::crypto::ring::default_provider().install_default();
        match self.command {
            Command::Serve(args) => serve::run(args),
            Command::Import(args) => import::run(args),
            Command::Query(args) => query::run(args),
            #[cfg(feature = "lab")]
            Command::Match(args) => match_images::run(args),
            Command::Extract(args) => extract::run(args),
            Command::Model(args) => model::run(args),
            #[cfg(feature = "lab")]
            Command::Head(args) => head::run(args),
            #[cfg(feature = "lab")]
            Command::Eval(args) => eval::run(args),
            #[cfg(feature = "lab")]
            Command::Train(args) => train::run(args),
            #[cfg(feature = "lab")]
            Command::Synth(args) => synth::run(args),
            #[cfg(feature = "lab")]
            Command::Demo(args) => demo::run(args),
            #[cfg(feature = "lab")]
            Command::Bench(args) => bench::run(args),
            Command::Load(args) => load::run(args),
            Command::Verify(args) => verify::run(args),
            Command::Backup(args) => backup::run(args),
            Command::Healthcheck(args) => healthcheck::run(args),
            Command::Openapi(args) => openapi::run(args),
            Command::Map(args) => map::run(args),
        }
    }
}
