// A device made of node-canopen. Usage: node canopen_slave.js PORT EDS NODE-ID SERIAL
//
// An I/O device by its EDS whose inputs show its outputs. node-canopen sends no boot-up message and knows no $NODEID: both
// are done here, as an application of it must. `emcy` on stdin sends an emergency. It prints what happens to it.

'use strict';

const fs = require('fs');
const net = require('net');
const os = require('os');
const path = require('path');
const { Device, Eds } = require('canopen');

const GREETING = 'CANNELLONIv1';
const RTR = 0x40000000;
const EXTENDED_OR_ERROR = 0xA0000000;
const INITIALIZING = 0, OPERATIONAL = 5, PRE_OPERATIONAL = 127;

const [port, edsFile, id, serial] = process.argv.slice(2);
const nodeId = Number(id);

function say(text) {
    fs.writeSync(1, `${text}\n`);
}

/** The EDS with every formula worked out, and without what node-canopen refuses: PDOMapping of a DOMAIN, even 0. */
function loadEds() {
    const text = fs.readFileSync(edsFile, 'utf8')
        .replace(/\$NODEID\+(0x[0-9A-Fa-f]+)/g, (_, base) => `0x${(Number(base) + nodeId).toString(16)}`)
        .replace(/(DataType=0x000F\s+AccessType=rw\s+)PDOMapping=0/g, '$1');
    const file = path.join(fs.mkdtempSync(path.join(os.tmpdir(), 'dinrail-node-')), 'device.eds');
    fs.writeFileSync(file, text);
    const eds = Eds.fromFile(file);
    fs.rmSync(path.dirname(file), { recursive: true });
    return eds;
}

/** Frames over a cannelloni TCP connection: id and flags, length, data. */
class Bus {
    constructor(onFrame) {
        this.buffer = Buffer.alloc(0);
        this.greeted = false;
        this.socket = net.connect(Number(port), '127.0.0.1');
        this.socket.setNoDelay(true);
        this.socket.write(GREETING);
        this.socket.on('data', (data) => {
            this.buffer = Buffer.concat([this.buffer, data]);
            this.take(onFrame);
        });
        this.socket.on('close', () => process.exit(0));
        this.socket.on('error', () => process.exit(0));
    }

    take(onFrame) {
        let at = 0;
        if (!this.greeted) {
            if (this.buffer.length < GREETING.length)
                return;
            this.greeted = true;
            at = GREETING.length;
            setImmediate(() => this.onReady());
        }
        while (this.buffer.length >= at + 5) {
            const canId = this.buffer.readUInt32BE(at);
            const length = this.buffer[at + 4];
            const bytes = (canId & RTR) ? 0 : length;
            if (this.buffer.length < at + 5 + bytes)
                break;
            const data = this.buffer.subarray(at + 5, at + 5 + bytes);
            at += 5 + bytes;
            if (!(canId & EXTENDED_OR_ERROR) && !(canId & RTR))
                onFrame({ id: canId, len: bytes, data: Buffer.from(data) });
        }
        this.buffer = this.buffer.subarray(at);
    }

    send({ id: canId, data }) {
        const frame = Buffer.alloc(5 + data.length);
        frame.writeUInt32BE(canId, 0);
        frame[4] = data.length;
        data.copy(frame, 5);
        this.socket.write(frame);
    }
}

const eds = loadEds();
const device = new Device({ id: nodeId, eds, enableLss: false });
eds.addSdoServerParameter(0, 0x580 + nodeId, 0x600 + nodeId);
const bus = new Bus((message) => device.receive(message));
device.addListener('message', (message) => bus.send(message));

/** The inputs show the outputs. */
function show() {
    for (const [from, to, count] of [[0x6200, 0x6000, 2], [0x6411, 0x6401, 4]]) {
        for (let sub = 1; sub <= count; ++sub)
            eds.getEntry(to)[sub].value = eds.getEntry(from)[sub].value;
    }
}

device.pdo.on('pdo', show);

let last = INITIALIZING;
device.nmt.on('changeState', (state) => {
    if (state === PRE_OPERATIONAL && last === INITIALIZING) {
        eds.getEntry(0x1018)[4].value = Number(serial);
        bus.send({ id: 0x700 + nodeId, data: Buffer.from([0]) });
        say('booted');
    }
    if (state === OPERATIONAL)
        say(`operational 0x${eds.getEntry(0x2001).value.toString(16)}`);
    last = state;
});

bus.onReady = () => {
    device.start();
    say('ready');
};

process.stdin.on('data', (text) => {
    if (text.toString().includes('emcy'))
        device.emcy.write(0x4210, Buffer.from('heat!'));
});
