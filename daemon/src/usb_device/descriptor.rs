//! Descriptors and the standard requests that read them (USB 2.0 and 3.2, chapter 9).

use super::{ControlReply, Setup};

/// Speed of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Speed {
    /// 12 Mbit/s.
    Full,
    /// 480 Mbit/s.
    High,
    /// 5 Gbit/s.
    Super,
}

impl Speed {
    /// Largest packet of a bulk endpoint.
    pub fn bulk_packet_bytes(self) -> u16 {
        match self {
            Self::Full => 64,
            Self::High => 512,
            Self::Super => 1024,
        }
    }

    /// Code in Linux' enum usb_device_speed, which USB/IP has as well.
    pub fn linux_code(self) -> u32 {
        match self {
            Self::Full => 2,
            Self::High => 3,
            Self::Super => 5,
        }
    }
}

/// How an endpoint moves data (bmAttributes).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TransferKind {
    /// When there is room on the bus.
    Bulk,
    /// At least once an interval; `interval` is bInterval as the speed counts it.
    Interrupt {
        /// bInterval.
        interval: u8,
        /// Largest packet.
        packet_bytes: u16,
    },
}

/// Who a device says it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// Vendor.
    pub vendor_id: u16,
    /// Product.
    pub product_id: u16,
    /// Release, binary coded decimal.
    pub release: u16,
    /// Class, subclass and protocol of the device; 0xef, 2, 1 where interfaces stand in associations.
    pub class: [u8; 3],
    /// Maker.
    pub manufacturer: String,
    /// Model.
    pub product: String,
    /// Serial number.
    pub serial: String,
}

/// Descriptors of a configuration in the making, interface by interface.
#[derive(Debug)]
pub struct Configuration {
    speed: Speed,
    interfaces: u8,
    bytes: Vec<u8>,
}

impl Configuration {
    /// A configuration without interfaces.
    pub fn new(speed: Speed) -> Self {
        Self { speed, interfaces: 0, bytes: Vec::new() }
    }

    /// The next `count` interfaces are one function.
    #[must_use]
    pub fn association(mut self, count: u8, class: [u8; 3]) -> Self {
        self.bytes.extend([8, 0x0b, self.interfaces, count, class[0], class[1], class[2], 0]);
        self
    }

    /// The next interface, with a number of endpoints.
    #[must_use]
    pub fn interface(mut self, endpoints: u8, class: [u8; 3]) -> Self {
        self.bytes.extend([9, 4, self.interfaces, 0, endpoints, class[0], class[1], class[2], 0]);
        self.interfaces += 1;
        self
    }

    /// A descriptor of the class of the last interface; its length byte is put in front.
    ///
    /// # Panics
    /// When it is longer than 254 bytes.
    #[must_use]
    pub fn class_descriptor(mut self, body: &[u8]) -> Self {
        assert!(body.len() < 255, "a descriptor has at most 255 bytes");
        self.bytes.push(body.len() as u8 + 1);
        self.bytes.extend_from_slice(body);
        self
    }

    /// An endpoint of the last interface; bit 7 of `address` is set for IN.
    #[must_use]
    pub fn endpoint(mut self, address: u8, kind: TransferKind) -> Self {
        let (attributes, packet_bytes, interval) = match kind {
            TransferKind::Bulk => (2, self.speed.bulk_packet_bytes(), 0),
            TransferKind::Interrupt { interval, packet_bytes } => (3, packet_bytes, interval),
        };
        let packet = packet_bytes.to_le_bytes();
        self.bytes.extend([7, 5, address, attributes, packet[0], packet[1], interval]);
        if self.speed == Speed::Super {
            let per_interval = if attributes == 3 { packet } else { [0, 0] };
            // Companion: no bursts, which no wire here would gain from.
            self.bytes.extend([6, 0x30, 0, 0, per_interval[0], per_interval[1]]);
        }
        self
    }

    /// Configuration descriptor, self-powered.
    fn finish(self) -> Vec<u8> {
        let total = (self.bytes.len() as u16 + 9).to_le_bytes();
        let mut all = vec![9, 2, total[0], total[1], self.interfaces, 1, 0, 0xc0, 0];
        all.extend(self.bytes);
        all
    }
}

/// What a host is told of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Descriptors {
    /// Speed that the endpoints are described for.
    pub speed: Speed,
    /// Who it is.
    pub identity: Identity,
    configuration: Vec<u8>,
}

impl Descriptors {
    /// A device of one configuration.
    pub fn new(identity: Identity, configuration: Configuration) -> Self {
        Self { speed: configuration.speed, identity, configuration: configuration.finish() }
    }

    /// A device that brings its own descriptors; none when the device descriptor is no such thing.
    pub fn read(speed: Speed, device: &[u8], configuration: Vec<u8>) -> Option<Self> {
        let &[18, 1, _, _, c, s, p, _, v0, v1, p0, p1, r0, r1, _, _, _, _] = device else { return None };
        let [vendor_id, product_id, release] = [[v0, v1], [p0, p1], [r0, r1]].map(u16::from_le_bytes);
        let [manufacturer, product, serial] = [(); 3].map(|()| String::new());
        let identity = Identity { vendor_id, product_id, release, class: [c, s, p], manufacturer, product, serial };
        Some(Self { speed, identity, configuration })
    }

    /// Class, subclass and protocol of every interface.
    pub fn interfaces(&self) -> Vec<[u8; 3]> {
        self.parts().filter(|d| d[1] == 4).map(|d| [d[5], d[6], d[7]]).collect()
    }

    /// Every endpoint: number of its interface, address, attributes, largest packet, interval.
    pub fn endpoints(&self) -> Vec<Endpoint> {
        let mut interface = 0;
        let mut endpoints = Vec::new();
        for d in self.parts() {
            match d[1] {
                4 => interface = d[2],
                5 => endpoints.push(Endpoint {
                    interface,
                    address: d[2],
                    attributes: d[3],
                    packet_bytes: u16::from_le_bytes([d[4], d[5]]),
                    interval: d[6],
                }),
                _ => {}
            }
        }
        endpoints
    }

    /// Descriptors within the configuration; interfaces and endpoints are whole.
    fn parts(&self) -> impl Iterator<Item = &[u8]> {
        let mut rest = &self.configuration[..];
        std::iter::from_fn(move || {
            let (part, after) = rest.split_at_checked(usize::from(*rest.first()?).max(1))?;
            rest = after;
            Some(part)
        })
        .filter(|d| d.len() >= 2 && !(d[1] == 4 && d.len() < 9) && !(d[1] == 5 && d.len() < 7))
    }

    /// Device descriptor.
    pub fn device(&self) -> [u8; 18] {
        let id = &self.identity;
        let [v, p, r] = [id.vendor_id, id.product_id, id.release].map(u16::to_le_bytes);
        let [c, s, t] = id.class;
        // On SuperSpeed the control endpoint's packet is a power of two.
        let (usb, packet) = if self.speed == Speed::Super { (3, 9) } else { (2, 64) };
        [18, 1, 0, usb, c, s, t, packet, v[0], v[1], p[0], p[1], r[0], r[1], 1, 2, 3, 1]
    }

    /// Configuration descriptor with all that belongs to it.
    pub fn configuration(&self) -> &[u8] {
        &self.configuration
    }

    fn descriptor(&self, value: u16) -> Option<Vec<u8>> {
        let device = self.device();
        match value.to_be_bytes() {
            [1, _] => Some(device.to_vec()),
            [2, 0] => Some(self.configuration.clone()),
            [3, index] => self.string(index),
            // Device qualifier: nothing else at another speed.
            [6, _] if self.speed == Speed::High => {
                Some(vec![10, 6, 0, 2, device[4], device[5], device[6], device[7], 1, 0])
            }
            // Binary object store: USB 2.0 extension and SuperSpeed capabilities.
            [15, _] if self.speed == Speed::Super => {
                Some(vec![5, 15, 22, 0, 2, 7, 16, 2, 2, 0, 0, 0, 10, 16, 3, 0, 14, 0, 1, 10, 255, 7])
            }
            _ => None,
        }
    }

    fn string(&self, index: u8) -> Option<Vec<u8>> {
        let text = match index {
            0 => return Some(vec![4, 3, 0x09, 0x04]),
            1 => &self.identity.manufacturer,
            2 => &self.identity.product,
            3 => &self.identity.serial,
            _ => return None,
        };
        let mut bytes = vec![0, 3];
        // The length byte counts 126 units at most.
        bytes.extend(text.encode_utf16().take(126).flat_map(u16::to_le_bytes));
        bytes[0] = bytes.len() as u8;
        Some(bytes)
    }

    /// Answers a standard request; none when it is one for the device.
    pub fn answer(&self, setup: &Setup) -> Option<ControlReply> {
        if setup.request_type & 0x60 != 0 {
            return None;
        }
        let data = |bytes: Option<Vec<u8>>| bytes.map(ControlReply::Data);
        match (setup.request_type, setup.request) {
            (0x80, 6) => data(self.descriptor(setup.value)).or(Some(ControlReply::Stall)),
            // Descriptors of an interface belong to its class.
            (0x81, 6) => None,
            (0x80, 0) => data(Some(vec![1, 0])),
            (0x81 | 0x82, 0) => data(Some(vec![0, 0])),
            (0x80, 8) => data(Some(vec![1])),
            (0x81, 10) => data(Some(vec![0])),
            // Set configuration, interface, clear and set feature, isochronous delay, sleep figures.
            (0x00, 9) | (0x01, 11) | (0x00..=0x02, 1 | 3) | (0x00, 0x30 | 0x31) => Some(ControlReply::Done),
            _ => Some(ControlReply::Stall),
        }
    }
}

/// An endpoint as its descriptor says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Endpoint {
    /// Number of its interface.
    pub interface: u8,
    /// Number, with bit 7 for IN.
    pub address: u8,
    /// Kind in bits 1..0: 1 isochronous, 2 bulk, 3 interrupt.
    pub attributes: u8,
    /// Largest packet.
    pub packet_bytes: u16,
    /// bInterval.
    pub interval: u8,
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn example(speed: Speed) -> Descriptors {
        let identity = Identity {
            vendor_id: 0x1209,
            product_id: 0x0001,
            release: 0x0102,
            class: [0xff, 0, 0],
            manufacturer: "gv3".into(),
            product: "loop".into(),
            serial: "1".into(),
        };
        let interrupt = TransferKind::Interrupt { interval: 4, packet_bytes: 16 };
        let configuration = Configuration::new(speed)
            .interface(3, [0xff, 1, 2])
            .class_descriptor(&[0x24, 1, 2])
            .endpoint(0x01, TransferKind::Bulk)
            .endpoint(0x81, TransferKind::Bulk)
            .endpoint(0x82, interrupt);
        Descriptors::new(identity, configuration)
    }

    #[test]
    fn configuration_bytes() {
        let expected = [
            9, 2, 43, 0, 1, 1, 0, 0xc0, 0, // configuration
            9, 4, 0, 0, 3, 0xff, 1, 2, 0, // interface
            4, 0x24, 1, 2, // its class's
            7, 5, 0x01, 2, 0, 2, 0, 7, 5, 0x81, 2, 0, 2, 0, 7, 5, 0x82, 3, 16, 0, 4, // endpoints
        ];
        let descriptors = example(Speed::High);
        assert_eq!(descriptors.configuration(), expected);
        assert_eq!(descriptors.interfaces(), [[0xff, 1, 2]]);
        let last = Endpoint { interface: 0, address: 0x82, attributes: 3, packet_bytes: 16, interval: 4 };
        assert_eq!(descriptors.endpoints()[2], last);
        assert_eq!(example(Speed::Super).configuration().len(), 43 + 3 * 6);
    }

    #[test]
    fn standard_requests() {
        let descriptors = example(Speed::High);
        let get = |value| descriptors.answer(&Setup { request_type: 0x80, request: 6, value, index: 0, length: 255 });
        let device = [18, 1, 0, 2, 0xff, 0, 0, 64, 0x09, 0x12, 1, 0, 2, 1, 1, 2, 3, 1];
        assert_eq!(get(0x0100), Some(ControlReply::Data(device.to_vec())));
        assert_eq!(get(0x0302), Some(ControlReply::Data(vec![10, 3, b'l', 0, b'o', 0, b'o', 0, b'p', 0])));
        assert_eq!(get(0x0304), Some(ControlReply::Stall));
        assert_eq!(get(0x0f00), Some(ControlReply::Stall));
        let class = Setup { request_type: 0x21, request: 6, value: 0, index: 0, length: 0 };
        assert_eq!(descriptors.answer(&class), None);
        let own = Descriptors::read(Speed::High, &device, descriptors.configuration().to_vec()).unwrap();
        assert_eq!((own.device(), own.endpoints()), (device, descriptors.endpoints()));
        assert_eq!(Descriptors::read(Speed::High, &device[1..], vec![]), None);
        let report = Setup { request_type: 0x81, request: 6, value: 0x2200, index: 0, length: 64 };
        assert_eq!(descriptors.answer(&report), None);
    }
}
