// SPDX-License-Identifier: GPL-3.0-or-later
// Stands for what a Flamenco Manager gives to a job type: runs the script on each of the settings
// in the JSON list on standard input; prints for each the job type and the tasks, or the error.

const fs = require("fs");
const vm = require("vm");

function Task(name, type) {
    if (arguments.length !== 2 || typeof name !== "string" || typeof type !== "string") {
        throw new Error("author.Task wants a name and a type");
    }
    this.name = name;
    this.type = type;
    this.commands = [];
    this.needs = [];
    this.added = false;
}
Task.prototype.addCommand = function (command) { this.commands.push(command); };
Task.prototype.addDependency = function (other) {
    if (!(other instanceof Task)) {
        throw new Error("addDependency wants a task");
    }
    this.needs.push(other.name);
};

const author = {
    Task: function (name, type) { return new Task(name, type); },
    Command: function (name, parameters) { return { name: name, parameters: parameters }; },
};

function compiled(settings) {
    const job = { settings: settings, tasks: [] };
    job.addTask = function (task) {
        task.added = true;
        job.tasks.push(task);
    };
    // Nothing of node is there for the script, as nothing of it is in a Manager.
    const context = vm.createContext({ author: author });
    vm.runInContext(fs.readFileSync(process.argv[2], "utf8"), context);
    const answer = { jobType: vm.runInContext("JOB_TYPE", context) };
    try {
        context.compileJob(job);
        answer.tasks = job.tasks;
    } catch (error) {
        answer.error = error.message;
    }
    return answer;
}

process.stdout.write(JSON.stringify(JSON.parse(fs.readFileSync(0, "utf8")).map(compiled)));
