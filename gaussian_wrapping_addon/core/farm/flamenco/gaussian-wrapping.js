// SPDX-License-Identifier: GPL-3.0-or-later
//
// Flamenco job type "Gaussian Wrapping": each part of a job folder becomes one task.
// Put this file into the folder "scripts" beside flamenco-manager and restart the Manager.
// The add-on's panel and its command "farm submit" fill in all settings.

const SCRIPT_VERSION = 1;
const FORMAT_VERSION = 1;
const MAX_PARTS = 50000;
const MAX_THREADS = 1024;
const PART_NAME = /^[A-Za-z0-9][A-Za-z0-9_-]{0,79}$/;
const DEVICE = /^(auto|cpu|cuda(:[0-9]{1,3})?)?$/;

// All workers run tasks of this type unless they are configured otherwise.
const TASK_TYPE = "misc";

const JOB_TYPE = {
    label: "Gaussian Wrapping",
    description: "Photos to a textured mesh, in parts. Submitted by the add-on Gaussian Wrapping",
    settings: [
        {
            key: "parts", type: "string", required: true, visible: "hidden",
            description: "Names, kinds and needs of the parts, as JSON",
        },
        {
            key: "job_folder", type: "string", required: true, visible: "web",
            description: "The job folder as workers see it, such as {gw_shared}/jobs/castle",
        },
        {
            key: "python", type: "string", default: "{gw_python}", visible: "web",
            description: "Python of the worker's environment; empty where the program needs none",
        },
        {
            key: "program", type: "string", default: "{gw_batch}", visible: "web",
            description: "batch.py of the add-on",
        },
        {
            key: "threads", type: "int32", default: 0, visible: "web",
            description: "Processor threads of a part; 0 uses all",
        },
        {
            key: "device", type: "string", default: "", visible: "web",
            description: "auto, cpu, cuda or cuda:N; empty is the job's own",
        },
        {
            key: "script_version", type: "int32", default: SCRIPT_VERSION, visible: "hidden",
            description: "Version of this script",
        },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    checkSettings(settings);
    const parts = readParts(settings.parts);
    const tasks = new Map();
    for (const part of parts) {
        const task = author.Task(part.name, TASK_TYPE);
        task.addCommand(author.Command("exec", commandOf(settings, part.name)));
        tasks.set(part.name, task);
    }
    for (const part of parts) {
        for (const need of part.needs) {
            tasks.get(part.name).addDependency(tasks.get(need));
        }
    }
    for (const part of parts) {
        job.addTask(tasks.get(part.name));
    }
}

// The program and its arguments. No shell sees them: each argument arrives as it is.
function commandOf(settings, name) {
    const args = ["run-part", settings.job_folder, name];
    if (settings.threads) {
        args.push("--threads", String(settings.threads));
    }
    if (settings.device) {
        args.push("--device", settings.device);
    }
    if (settings.python) {
        return { exe: settings.python, args: [settings.program].concat(args) };
    }
    return { exe: settings.program, args: args };
}

function refuse(words) {
    throw new Error("Gaussian Wrapping: " + words);
}

function checkSettings(settings) {
    if (settings.script_version !== SCRIPT_VERSION) {
        refuse("this script has version " + SCRIPT_VERSION + ", the job was made for version "
            + settings.script_version + ". Install the script of the add-on that submits.");
    }
    checkText(settings.job_folder, "job_folder", true);
    checkText(settings.program, "program", true);
    checkText(settings.python, "python", false);
    if (settings.job_folder.split(/[\\/]/).indexOf("..") >= 0) {
        refuse("job_folder must not contain '..'.");
    }
    const threads = settings.threads;
    if (typeof threads !== "number" || Math.floor(threads) !== threads
        || threads < 0 || threads > MAX_THREADS) {
        refuse("threads must be a whole number from 0 to " + MAX_THREADS + ".");
    }
    if (typeof settings.device !== "string" || !DEVICE.test(settings.device)) {
        refuse("device must be auto, cpu, cuda, cuda:N or empty.");
    }
}

// An argument that begins with a dash would be an option of the program.
function checkText(text, name, required) {
    if (typeof text !== "string" || (required && !text)) {
        refuse(name + " must be a text" + (required ? ", and not an empty one." : "."));
    }
    if (text.charAt(0) === "-" || /[\x00-\x1f]/.test(text)) {
        refuse(name + " begins with a dash, or has a line break or another control character.");
    }
}

function readParts(text) {
    let values = null;
    try {
        values = JSON.parse(text);
    } catch (error) {
        refuse("the setting parts is not JSON. Submit the job again.");
    }
    if (values === null || typeof values !== "object" || values.version !== FORMAT_VERSION) {
        refuse("the setting parts has not format version " + FORMAT_VERSION + ".");
    }
    const parts = values.parts;
    if (!Array.isArray(parts) || parts.length < 1 || parts.length > MAX_PARTS) {
        refuse("the setting parts must list 1 to " + MAX_PARTS + " parts.");
    }
    const names = new Set();
    parts.forEach(function (part, index) {
        const where = "part number " + (index + 1);
        if (part === null || typeof part !== "object" || typeof part.name !== "string"
            || !PART_NAME.test(part.name)) {
            refuse(where + " has no name of letters, digits, _ and -.");
        }
        if (names.has(part.name)) {
            refuse("the name " + part.name + " is there twice.");
        }
        if (typeof part.kind !== "string" || !Array.isArray(part.needs)) {
            refuse("part " + part.name + " has no kind or no list of needs.");
        }
        names.add(part.name);
    });
    for (const part of parts) {
        for (const need of part.needs) {
            if (!names.has(need)) {
                refuse("part " + part.name + " needs " + need + ", which is no part.");
            }
        }
        if (new Set(part.needs).size !== part.needs.length) {
            refuse("part " + part.name + " needs another one twice.");
        }
    }
    refuseCircles(parts);
    return parts;
}

// Tasks that wait for each other would stay queued for ever.
function refuseCircles(parts) {
    const missing = new Map();
    const after = new Map();
    for (const part of parts) {
        missing.set(part.name, part.needs.length);
        after.set(part.name, []);
    }
    for (const part of parts) {
        for (const need of part.needs) {
            after.get(need).push(part.name);
        }
    }
    const names = Array.from(missing.keys());
    const ready = names.filter(function (name) { return missing.get(name) === 0; });
    while (ready.length) {
        for (const name of after.get(ready.pop())) {
            missing.set(name, missing.get(name) - 1);
            if (missing.get(name) === 0) {
                ready.push(name);
            }
        }
    }
    const waiting = names.filter(function (name) { return missing.get(name) > 0; });
    if (waiting.length) {
        refuse("the parts " + waiting.slice(0, 3).join(", ") + " wait for each other.");
    }
}
