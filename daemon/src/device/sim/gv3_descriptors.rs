//! USB descriptors of a projector that speaks the vendor protocol: one interface, three endpoints.

use gv3_protocol::gv3::{
    INTERFACE_CLASS, INTERFACE_PROTOCOL, INTERFACE_SUBCLASS, Identity, MAX_EVENT_BYTES, PRODUCT_ID, VENDOR_ID,
};

/// Bulk, host to device.
pub const OUT: u8 = 0x01;
/// Bulk, device to host.
pub const IN: u8 = 0x81;
/// Interrupt, device to host.
pub const EVENTS: u8 = 0x82;
/// wMaxPacketSize of the bulk endpoints at high speed.
pub const HIGH_SPEED_PACKET_BYTES: u16 = 512;

/// What GET_DESCRIPTOR answers; `None` for what there is not.
pub fn descriptor(kind: u8, index: u8, identity: &Identity, bulk_packet_bytes: u16) -> Option<Vec<u8>> {
    match kind {
        1 => Some(device(identity)),
        2 if index == 0 => Some(configuration(bulk_packet_bytes)),
        3 => string(index, identity),
        _ => None,
    }
}

fn device(identity: &Identity) -> Vec<u8> {
    let mut bytes = vec![18, 1];
    let class = [0, 0, 0];
    bytes.extend(0x0200u16.to_le_bytes());
    bytes.extend(class);
    bytes.push(64);
    bytes.extend([VENDOR_ID, PRODUCT_ID, identity.firmware_version].into_iter().flat_map(u16::to_le_bytes));
    // Strings 1 maker, 2 product, 3 serial number; one configuration.
    bytes.extend([1, 2, 3, 1]);
    bytes
}

fn configuration(bulk_packet_bytes: u16) -> Vec<u8> {
    const SELF_POWERED: u8 = 0xc0;
    let (bulk, interrupt) = (2, 3);
    // The interrupt endpoint is asked every millisecond: 2^(4-1) microframes at high speed, one frame at full speed.
    let interval = if bulk_packet_bytes == HIGH_SPEED_PACKET_BYTES { 4 } else { 1 };
    let endpoints = [
        (OUT, bulk, bulk_packet_bytes, 0),
        (IN, bulk, bulk_packet_bytes, 0),
        (EVENTS, interrupt, MAX_EVENT_BYTES as u16, interval),
    ];
    let mut body = vec![9, 4, 0, 0, 3, INTERFACE_CLASS, INTERFACE_SUBCLASS, INTERFACE_PROTOCOL, 2];
    for (address, kind, packet_bytes, interval) in endpoints {
        body.extend([7, 5, address, kind]);
        body.extend(packet_bytes.to_le_bytes());
        body.push(interval);
    }
    let mut bytes = vec![9, 2];
    bytes.extend((9 + body.len() as u16).to_le_bytes());
    bytes.extend([1, 1, 0, SELF_POWERED, 50]);
    bytes.extend(body);
    bytes
}

fn string(index: u8, identity: &Identity) -> Option<Vec<u8>> {
    let units: Vec<u16> = match index {
        // Languages: English (United States).
        0 => vec![0x0409],
        1 => "gv3".encode_utf16().collect(),
        2 => identity.model.encode_utf16().collect(),
        3 => identity.serial.encode_utf16().collect(),
        _ => return None,
    };
    let units = &units[..units.len().min(126)];
    let mut bytes = vec![2 + 2 * units.len() as u8, 3];
    bytes.extend(units.iter().flat_map(|unit| unit.to_le_bytes()));
    Some(bytes)
}
