//! The same picture, written anew as the plainest JPEG that shows it.
//!
//! The decoding libraries differ in what they tolerate. Of what is written here none has anything
//! to tolerate: no metadata, no stray bytes, every table just before its use, the end marker in its
//! place. The compressed data are copied, not coded again.

use super::COEFFICIENTS;
use super::entropy::{self, NonZero};
use super::fault::Fault;
use super::frame::{Frame, Scan, TableInUse};
use super::progress::Progress;
use super::syntax::Layout;

/// Checks that a picture is complete, and writes it anew.
pub(super) fn write(layout: &Layout<'_>) -> Result<Vec<u8>, Fault> {
    let Layout { frame, scans, .. } = layout;
    let mut progress = Progress::new(frame);
    for (number, scan) in (1..).zip(scans) {
        progress.add(frame, scan, number)?;
    }
    progress.finish(layout.ended)?;

    let data_bytes: usize = scans.iter().map(|scan| scan.data.len()).sum();
    let mut bytes = Vec::with_capacity(data_bytes + 4096);
    bytes.extend_from_slice(b"\xff\xd8");
    quantisers(frame, &mut bytes)?;
    frame_header(frame, &mut bytes);
    let mut non_zero = non_zero(frame, scans);
    let mut restart_interval = 0;
    for (number, scan) in (1..).zip(scans) {
        if scan.restart_interval != restart_interval {
            restart_interval = scan.restart_interval;
            segment(0xdd, &(restart_interval as u16).to_be_bytes(), &mut bytes);
        }
        huffman_tables(scan, &mut bytes);
        scan_header(scan, &mut bytes);
        entropy::copy_data(frame, scan, number, &mut non_zero, &mut bytes)?;
    }
    bytes.extend_from_slice(b"\xff\xd9");
    Ok(bytes)
}

/// Room for which coefficients are not zero, for the components that a scan refines.
fn non_zero(frame: &Frame, scans: &[Scan<'_>]) -> Vec<NonZero> {
    let is_refined = |component: usize| {
        let mut refinements = scans
            .iter()
            .filter(|scan| scan.is_refinement() && !scan.is_dc());
        refinements.any(|scan| scan.parts[0].component == component)
    };
    let components = frame.components.iter().enumerate();
    let room = components.map(|(place, component)| match is_refined(place) {
        true => vec![0; frame.blocks_alone(component).area() as usize],
        false => Vec::new(),
    });
    room.collect()
}

/// A segment of less than 65,534 bytes.
fn segment(marker: u8, body: &[u8], bytes: &mut Vec<u8>) {
    bytes.extend_from_slice(&[0xff, marker]);
    bytes.extend_from_slice(&(body.len() as u16 + 2).to_be_bytes());
    bytes.extend_from_slice(body);
}

/// The quantisers of each component, in the slot that has its place.
fn quantisers(frame: &Frame, bytes: &mut Vec<u8>) -> Result<(), Fault> {
    for (place, component) in (0u8..).zip(&frame.components) {
        let values = component.quantisers.ok_or(Fault::QuantisersMissing)?;
        let mut body = Vec::with_capacity(1 + 2 * COEFFICIENTS);
        if values.iter().all(|&value| value < 256) {
            body.push(place);
            body.extend(values.iter().map(|&value| value as u8));
        } else {
            body.push(0x10 | place);
            body.extend(values.iter().flat_map(|value| value.to_be_bytes()));
        }
        segment(0xdb, &body, bytes);
    }
    Ok(())
}

fn frame_header(frame: &Frame, bytes: &mut Vec<u8>) {
    let mut body = vec![8];
    // The sides of a JPEG are 16-bit numbers.
    body.extend_from_slice(&(frame.size.height as u16).to_be_bytes());
    body.extend_from_slice(&(frame.size.width as u16).to_be_bytes());
    body.push(frame.components.len() as u8);
    for (place, component) in (0u8..).zip(&frame.components) {
        let (horizontal, vertical) = component.sampling;
        body.extend_from_slice(&[place + 1, (horizontal << 4 | vertical) as u8, place]);
    }
    // Extended sequential pictures may use all four slots for tables, unlike baseline ones.
    segment(if frame.progressive { 0xc2 } else { 0xc1 }, &body, bytes);
}

/// The tables that are in the slots that a scan names. Those that it does not use are not derived,
/// so they may be missing or corrupt.
fn huffman_tables(scan: &Scan<'_>, bytes: &mut Vec<u8>) {
    let needed = entropy::tables_needed(scan);
    let classes = [(0x00, needed.dc), (0x10, needed.ac)];
    for (class, is_needed) in classes {
        let mut written = [false; 4];
        for part in scan.parts.iter().filter(|_| is_needed) {
            let TableInUse { slot, table } = if class == 0 { part.dc } else { part.ac };
            let Some(table) = table else { continue };
            if std::mem::replace(&mut written[usize::from(slot)], true) {
                continue;
            }
            let body = [&[class | slot][..], table.counts, table.symbols].concat();
            segment(0xc4, &body, bytes);
        }
    }
}

fn scan_header(scan: &Scan<'_>, bytes: &mut Vec<u8>) {
    let mut body = vec![scan.parts.len() as u8];
    for part in &scan.parts {
        body.extend_from_slice(&[part.component as u8 + 1, part.dc.slot << 4 | part.ac.slot]);
    }
    let (first, last) = scan.band;
    body.extend_from_slice(&[first as u8, last as u8, scan.high << 4 | scan.low]);
    segment(0xda, &body, bytes);
}
