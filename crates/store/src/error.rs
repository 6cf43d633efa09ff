//! Why the store could not do as asked.

use placeformer_core::error::ErrorCode;
use placeformer_core::types::{ExternalId, MapName, ModelId, ReferenceId};
use std::path::PathBuf;

/// The cause inside an engine failure; opaque, so that no type of the engine leaves the store.
pub type EngineCause = Box<dyn std::error::Error + Send + Sync>;

/// Why the store could not do as asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
    /// No map of this name.
    #[error("map {map} does not exist")]
    MapNotFound {
        /// The name asked for.
        map: MapName,
    },
    /// No reference of this identity.
    #[error("reference {id} does not exist")]
    ReferenceNotFound {
        /// The identity asked for.
        id: ReferenceId,
    },
    /// The external id belongs to a reference with other content.
    #[error(
        "external id {external_id} of map {map} belongs to reference {existing}, \
         which has other content"
    )]
    ExternalIdConflict {
        /// The map.
        map: MapName,
        /// The external id that both claim.
        external_id: ExternalId,
        /// The reference that it belongs to.
        existing: ReferenceId,
    },
    /// The map was built with another model.
    #[error("map {map} is bound to model {bound}; the descriptor comes from model {given}")]
    ModelMismatch {
        /// The map.
        map: MapName,
        /// The model all its descriptors come from.
        bound: ModelId,
        /// The model of the descriptor offered.
        given: ModelId,
    },
    /// The calibration was fitted for another model than the map's.
    #[error("map {map} is bound to model {bound}; the calibration was fitted for model {given}")]
    CalibrationMismatch {
        /// The map.
        map: MapName,
        /// The model all its descriptors come from.
        bound: ModelId,
        /// The model of the calibration offered.
        given: ModelId,
    },
    /// A reference fails its checksum or cannot be read; it is quarantined.
    #[error(
        "reference {id} is damaged on disk and quarantined: {reason}; \
         delete it or send its image again"
    )]
    CorruptRecord {
        /// The damaged reference.
        id: ReferenceId,
        /// What is wrong with it.
        reason: String,
    },
    /// A map's own record fails its checksum.
    #[error("the record of map {map} is damaged on disk; restore a backup, or delete the map")]
    CorruptMap {
        /// Its name as far as it can be read.
        map: String,
    },
    /// The head that a map keeps for itself fails its checksum.
    #[error(
        "the head that map {map} keeps is damaged on disk; \
         give it a head again, its references are whole"
    )]
    CorruptHead {
        /// The map.
        map: MapName,
    },
    /// A part of the database that belongs to no single record is damaged.
    #[error(
        "the database is damaged, noticed while {context}: {source}; \
         check the stopped store, or restore a backup"
    )]
    Damaged {
        /// What was being done.
        context: &'static str,
        /// What the engine said.
        source: EngineCause,
    },
    /// The descriptor offered breaks a rule of its type, which is a fault of the caller.
    #[error("the descriptor cannot be stored: {reason}")]
    InvalidDescriptor {
        /// Which rule it breaks.
        reason: String,
    },
    /// The new head could not be applied to the pooled vectors of the map.
    #[error("the new head does not fit what the map keeps of its images")]
    HeadNotApplied {
        /// What the caller's projection said.
        source: EngineCause,
    },
    /// No space is left for writing; reading and deleting still work.
    #[error("no space is left on the disk of the data directory")]
    DiskFull,
    /// The files of the store cannot be written, or are no longer those in the data directory, so
    /// that nothing may be acknowledged; what can be read is.
    #[error("the storage is lost: {reason}")]
    StorageLost {
        /// What is wrong with it.
        reason: String,
    },
    /// The database lacks commits that were acknowledged.
    #[error(
        "{lost} of {marked} acknowledged commits are missing from the database in {}, the last of \
         {at} (new references among them: {references}): its log was cut short or deleted, or an \
         older database was put in its place. Restore the log or a backup, or give them up with \
         `placeformer verify --accept-lost-tail`",
        directory.display()
    )]
    LostCommits {
        /// The data directory.
        directory: PathBuf,
        /// Commits that are missing.
        lost: i64,
        /// Commits that were acknowledged.
        marked: i64,
        /// New references in the missing commits.
        references: i64,
        /// When the last of them was acknowledged.
        at: time::OffsetDateTime,
    },
    /// Nobody can say whether the database lacks commits that were acknowledged.
    #[error(
        "{} {reason}, so nobody can say whether the newest commits are in the database. Put it \
         back, restore a backup, or go on with what is there with \
         `placeformer verify --accept-lost-tail`",
        path.display()
    )]
    NoCommitMark {
        /// Where the mark should be.
        path: PathBuf,
        /// What is there instead.
        reason: &'static str,
    },
    /// A log lies beside a database that has none, and would be applied to it.
    #[error(
        "{} is the log of another database than the one beside it: move it away, or put its own \
         database back",
        path.display()
    )]
    ForeignLog {
        /// The log.
        path: PathBuf,
    },
    /// Another process uses the data directory.
    #[error("the data directory {} is in use by another process ({holder})", directory.display())]
    Locked {
        /// The data directory.
        directory: PathBuf,
        /// What the lock file says about its holder.
        holder: String,
    },
    /// The database was written by a newer release.
    #[error(
        "the database has schema version {found}, this release knows up to {supported}: \
         use a newer release"
    )]
    SchemaTooNew {
        /// Version on disk.
        found: i64,
        /// Newest version known here.
        supported: i64,
    },
    /// A migration that was applied is not the one this release carries.
    #[error(
        "migration {version} was applied with other content than this release carries; \
         the database is not ours"
    )]
    MigrationChanged {
        /// Its number.
        version: i64,
    },
    /// The database was busy longer than it should ever be.
    #[error("the database is busy: {context}")]
    Busy {
        /// What was being done.
        context: &'static str,
    },
    /// A head is already being exchanged on this map.
    #[error("map {map} is already being given another head")]
    ReheadInProgress {
        /// The map.
        map: MapName,
    },
    /// The target of a backup exists already.
    #[error("{} exists already; a backup never overwrites", path.display())]
    BackupExists {
        /// The target.
        path: PathBuf,
    },
    /// The store is closing.
    #[error("the store is closing")]
    Closing,
    /// The file system refused.
    #[error("{context} {}: {source}", path.display())]
    Io {
        /// What was being done.
        context: &'static str,
        /// To which file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The engine refused.
    #[error("the database failed while {context}: {source}")]
    Engine {
        /// What was being done.
        context: &'static str,
        /// What the engine said.
        source: EngineCause,
    },
}

impl StoreError {
    /// The row of the error table.
    pub fn code(&self) -> ErrorCode {
        match self {
            Self::MapNotFound { .. } => ErrorCode::MapNotFound,
            Self::ReferenceNotFound { .. } => ErrorCode::ReferenceNotFound,
            Self::ExternalIdConflict { .. } => ErrorCode::ExternalIdConflict,
            Self::ModelMismatch { .. } => ErrorCode::ModelMismatch,
            Self::CalibrationMismatch { .. } => ErrorCode::CalibrationMismatch,
            Self::HeadNotApplied { .. } => ErrorCode::HeadMismatch,
            Self::CorruptRecord { .. }
            | Self::CorruptMap { .. }
            | Self::CorruptHead { .. }
            | Self::Damaged { .. } => ErrorCode::CorruptRecord,
            Self::DiskFull => ErrorCode::DiskFull,
            Self::StorageLost { .. } => ErrorCode::StorageLost,
            Self::Busy { .. } | Self::ReheadInProgress { .. } => ErrorCode::Overloaded,
            Self::Closing => ErrorCode::ShuttingDown,
            Self::InvalidDescriptor { .. }
            | Self::LostCommits { .. }
            | Self::NoCommitMark { .. }
            | Self::ForeignLog { .. }
            | Self::Locked { .. }
            | Self::SchemaTooNew { .. }
            | Self::MigrationChanged { .. }
            | Self::BackupExists { .. }
            | Self::Io { .. }
            | Self::Engine { .. } => ErrorCode::Internal,
        }
    }
}
